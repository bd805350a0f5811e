"""How well other sessions support the pose of a session in its map: ``Correction.quality``."""

from collections.abc import Collection, Iterable
from typing import ClassVar

import numpy as np

from fcslam.cloud.closure_log import ClosureLog
from fcslam.cloud.joint_graph import JointGraph
from fcslam.graph.evidence import AGREES_M, AGREES_RAD
from fcslam.places.matcher import PlaceMatch
from fcslam.records import KeyscanId, Place
from fcslam.storage.snapshot import Kept

FRESH_M = 8.0
"""Travel, in metres, within which a comparison counts in full; the next place is about 4 m away."""
HALVED_M = 10.0
"""Further travel, in metres, after which a comparison counts half: the robot may have been carried since."""
TIE_HALVED_M = 30.0
"""Travel, in metres, after which a place with closures to other sessions counts half."""


class CorrectionQuality(Kept):
    """Keeps the newest comparison of every session with another session of its map."""

    KEPT: ClassVar = {"_newest": dict[str, tuple[int, float]]}

    def __init__(self, graph: JointGraph) -> None:
        self._graph = graph
        self._newest: dict[str, tuple[int, float]] = {}
        """By session: number of the newest keyscan that took part, and the share of the surface seen by both sessions
        that agrees, in [0, 1]; less if a match differs or is not verified."""

    def update(self, place: Place, matches: Iterable[PlaceMatch], robots: Collection[str]) -> None:
        """Take the matches of a new place into account; ``robots`` share its map, whose estimate is current."""
        compared: dict[KeyscanId, list[PlaceMatch]] = {}
        for match in matches:
            # An unpredicted match that is not verified is most often an alias.
            if match.i.robot in robots and (match.predicted or match.M):
                for keyscan in (match.i, KeyscanId(place.id.robot, place.last)):
                    compared.setdefault(keyscan, []).append(match)
        for (session, last), found in compared.items():
            newest = self._newest.get(session)
            if newest is None or newest[0] <= last:
                self._newest[session] = last, self._share(found)

    def of(self, session: str, robots: Collection[str], closures: ClosureLog) -> float:
        """In [0, 1], as in ``Correction``; ``robots`` share the session's map."""
        newest = self._newest.get(session)
        if len(robots) == 1 or newest is None:
            return 0.0
        since_m, (last, share) = self._graph.travel_since(session), newest
        tied = np.sum(0.5 ** (since_m[closures.tied(session)] / TIE_HALVED_M))
        weight = 0.5 ** (max(since_m[last] - FRESH_M, 0.0) / HALVED_M)
        return share * float(weight * (1.0 - 0.5**tied))

    def _share(self, matches: list[PlaceMatch]) -> float:
        """The best share of the matches that fit, times the part of them that fit: half if it is not verified.

        Zero if matches are verified, but none of these fits.
        """
        fitting = [match for match in matches if self._fits(match)]
        verified = sum(match.M for match in fitting)
        if not fitting or (not verified and any(match.M for match in matches)):
            return 0.0
        return max(match.explained for match in fitting) * 0.5 * (len(fitting) + verified) / len(matches)

    def _fits(self, match: PlaceMatch) -> bool:
        off_m, off_rad = self._graph.innovation(match.i, match.j, match.T_i_j)
        return off_m <= AGREES_M and off_rad <= AGREES_RAD
