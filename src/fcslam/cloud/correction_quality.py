"""How well other sessions support the pose of a session in its map: ``Correction.quality``."""

from collections.abc import Collection, Iterable
from itertools import islice

import numpy as np

from fcslam.cloud.closure_log import ClosureLog
from fcslam.cloud.joint_graph import JointGraph
from fcslam.places.matcher import PlaceMatch
from fcslam.storage.state_file import State

MOST_TIES = 10
"""Number of closures after which more make no difference: 1 - 2^-10 is close to 1."""


class CorrectionQuality:
    """Keeps the newest comparison of every session with another session of its map."""

    def __init__(self, graph: JointGraph, off_m: float, off_rad: float) -> None:
        """A comparison supports the map if it differs from it by at most ``off_m`` metres and ``off_rad`` radians."""
        self._graph = graph
        self._off_m, self._off_rad = off_m, off_rad
        self._share: dict[str, float] = {}
        """Share of the surface seen by both sessions that agrees, in [0, 1]."""

    def update(self, matches: Iterable[PlaceMatch], robots: Collection[str]) -> None:
        """Take the matches of a new place into account; ``robots`` share its map, whose estimate is current."""
        shares: dict[str, float] = {}
        for match in matches:
            fits = self._fits(match)
            # An unpredicted match that neither fits nor is verified is most often an alias.
            if match.i.robot in robots and (fits or match.predicted or match.M):
                share = match.explained if fits else 0.0
                for session in (match.i.robot, match.j.robot):
                    shares[session] = max(share, shares.get(session, 0.0))
        self._share |= shares

    def state(self) -> State:
        """What ``restore`` needs."""
        return {"share": dict(self._share)}

    def restore(self, state: State) -> None:
        """Take over a ``state``."""
        self._share = state["share"]

    def of(self, session: str, robots: Collection[str], closures: ClosureLog) -> float:
        """In [0, 1], as in ``Correction``; ``robots`` share the session's map."""
        if len(robots) == 1:
            return 0.0
        count = sum(1 for _ in islice(closures.ties(session), MOST_TIES))
        return self._share.get(session, 0.0) * (1.0 - 0.5**count)

    def _fits(self, match: PlaceMatch) -> bool:
        off = self._graph.innovation(match.i, match.j, match.T_i_j)
        return bool(np.hypot(off[0], off[1]) <= self._off_m and abs(off[2]) <= self._off_rad)
