"""How well others bear out where a session is in its map: what `Correction.quality` says."""

from collections.abc import Collection, Iterable
from itertools import islice

import numpy as np

from fcslam.cloud.closure_log import ClosureLedger
from fcslam.cloud.joint_graph import JointGraph
from fcslam.places.matcher import PlaceMatch

MOST_TIES = 10
"""More closures make no difference: 1 - 2^-10 is as good as 1."""


class Support:
    """Keeps, of every session, what its newest comparison with another session of its map showed."""

    def __init__(self, graph: JointGraph, off_m: float, off_rad: float) -> None:
        """A comparison bears out the map where the two differ by no more than ``off_m`` and ``off_rad``."""
        self._graph = graph
        self._off_m, self._off_rad = off_m, off_rad
        self._share: dict[str, float] = {}
        """Of the surface that both have seen, what lies where both saw it."""

    def weigh(self, matches: Iterable[PlaceMatch], robots: Collection[str]) -> None:
        """Take note of a new place's matches; ``robots`` share its map, whose estimate is up to date."""
        shares: dict[str, float] = {}
        for match in matches:
            fits = self._fits(match)
            # Of places that only look alike, most are just that.
            if match.i.robot in robots and (fits or match.predicted or match.M):
                share = match.check.worse.explained if fits else 0.0
                for session in (match.i.robot, match.j.robot):
                    shares[session] = max(share, shares.get(session, 0.0))
        self._share |= shares

    def quality(self, session: str, robots: Collection[str], ledger: ClosureLedger) -> float:
        """In [0, 1], as in ``Correction``; ``robots`` share the session's map."""
        if len(robots) == 1:
            return 0.0
        count = sum(1 for _ in islice(ledger.ties(session), MOST_TIES))
        return self._share.get(session, 0.0) * (1.0 - 0.5**count)

    def _fits(self, match: PlaceMatch) -> bool:
        off = self._graph.innovation(match.i, match.j, match.check.T_a_b)
        return bool(np.hypot(off[0], off[1]) <= self._off_m and abs(off[2]) <= self._off_rad)
