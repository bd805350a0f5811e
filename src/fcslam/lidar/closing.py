"""Loop closing inside one robot: a submap is compared with earlier ones that may show the same place.

How far the estimate may be off grows with the shortest path through the pose graph (odometry and accepted closures),
not with time: after a closure the search is narrow again. A wide search is branch and bound over the whole window.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from pydantic import Field
from scipy.sparse import coo_array
from scipy.sparse.csgraph import dijkstra

from fcslam.config import Settings
from fcslam.geometry import se2
from fcslam.lidar.correlative import SearchConfig, SearchWindow, search
from fcslam.lidar.submap import Submap
from fcslam.lidar.verification import Verification, VerificationConfig, verify
from fcslam.records import FloatArray

SURPRISE_M, SURPRISE_RAD = 0.15, 0.03
"""A closure this far off its prediction asks for a solve at once."""
NARROW_M = 0.8
"""With so little drift to allow for, the prediction starts the alignment, and the loose gate is enough."""
PENDING_M = 60.0
"""Travel after which a closure that found no support is given up."""


class ClosingConfig(Settings):
    """Loop closing inside one robot."""

    gap_m: float = Field(default=12.0, gt=0, description="travel that must lie between two submaps to be compared")
    sight_m: float = Field(default=8.0, gt=0, description="anchors farther apart than this share too little tracking")
    candidates: int = Field(default=4, gt=0, description="earlier visits compared with one submap")
    drift: float = Field(default=0.03, gt=0, description="drift allowed for, per metre of path through the graph")
    drift_rad_m: float = Field(default=0.006, gt=0, description="the same in heading")
    widest_m: float = Field(default=15.0, gt=0, description="half side of the widest search")
    widest_rad: float = Field(default=0.7, gt=0, description="half angle of the widest search")
    least_score: float = Field(default=0.5, ge=0, le=1, description="likelihood a search must reach")


@dataclass(frozen=True, slots=True)
class AnchoredSubmap:
    """A submap with where it hangs in the pose graph."""

    keyscan: int
    travel_m: float
    """Path length up to the anchor (turning counts a little)."""
    submap: Submap


@dataclass(frozen=True, slots=True, eq=False)
class LocalClosure:
    """A verified closure between the anchors of two submaps (indices into the closer's list)."""

    earlier: int
    later: int
    check: Verification
    innovation: FloatArray
    """How far the measurement lies from the prediction (x, y, theta)."""
    slack_m: float
    """Drift allowed for when it was found."""

    @property
    def off_m(self) -> float:
        """Length of the innovation."""
        return float(np.hypot(self.innovation[0], self.innovation[1]))

    @property
    def is_surprising(self) -> bool:
        """Whether it says that the estimate is off."""
        return self.off_m > SURPRISE_M or abs(self.innovation[2]) > SURPRISE_RAD


class LoopCloser:
    """Collects a robot's submaps and says which closures hold."""

    def __init__(self, config: ClosingConfig, search_config: SearchConfig, verification: VerificationConfig) -> None:
        self._config = config
        self._search = search_config
        self._verification = verification
        self.places: list[AnchoredSubmap] = []
        self._accepted: list[LocalClosure] = []
        self._pending: list[LocalClosure] = []

    @property
    def has_closures(self) -> bool:
        """Whether any closure was accepted."""
        return bool(self._accepted)

    def add(self, place: AnchoredSubmap, poses: Sequence[FloatArray]) -> list[LocalClosure]:
        """Take in the next submap; closures that hold now (of it, and of earlier ones it supports).

        ``poses``: T_map_base of every keyscan so far.
        """
        self.places.append(place)
        later = len(self.places) - 1
        paths = self._paths_from(later)
        anchors = np.array([poses[p.keyscan] for p in self.places])
        found = [
            closure
            for earlier in self._candidates(later, anchors, paths)
            if (closure := self._compare(earlier, later, anchors, paths[earlier])) is not None
        ]
        return self._judge(found, anchors)

    def _paths_from(self, later: int) -> FloatArray:
        """Shortest path through the graph from one submap to every other, metres, shape (P,)."""
        n = len(self.places)
        travel = np.array([p.travel_m for p in self.places])
        rows = [*range(n - 1), *(c.earlier for c in self._accepted)]
        columns = [*range(1, n), *(c.later for c in self._accepted)]
        lengths = [*(np.diff(travel) + 1e-3), *(1.0 for _ in self._accepted)]
        links = coo_array((np.array(lengths), (np.array(rows), np.array(columns))), shape=(n, n))
        paths: FloatArray = dijkstra(links.tocsr(), directed=False, indices=[later])[0]
        return paths

    def _slack(self, path_m: float) -> tuple[float, float]:
        config = self._config
        return (
            min(config.widest_m, 0.3 + config.drift * path_m),
            min(config.widest_rad, 0.05 + config.drift_rad_m * path_m),
        )

    def _candidates(self, later: int, anchors: FloatArray, paths: FloatArray) -> list[int]:
        """The nearest submap of each earlier visit to the neighbourhood, nearest visits first."""
        travel = np.array([p.travel_m for p in self.places])
        distance = np.hypot(*(anchors[:, :2] - anchors[later, :2]).T)
        slack = np.array([self._slack(path)[0] for path in paths])
        near = (travel[later] - travel > self._config.gap_m) & (distance < self._config.sight_m + slack)
        indices = np.flatnonzero(near)
        if not len(indices):
            return []
        visits = np.split(indices, np.flatnonzero(np.diff(indices) > 1) + 1)
        best = [int(visit[np.argmin(distance[visit])]) for visit in visits]
        best.sort(key=lambda k: distance[k])
        return best[: self._config.candidates]

    def _compare(self, earlier: int, later: int, anchors: FloatArray, path_m: float) -> LocalClosure | None:
        a, b = self.places[earlier].submap, self.places[later].submap
        predicted = se2.between(anchors[earlier], anchors[later])
        radius, angle = self._slack(path_m)
        guess = predicted
        if radius > NARROW_M:
            window = SearchWindow(radius, angle)
            result = search(b.surface, a.field, predicted, window, self._search)
            if result.score < self._config.least_score:
                return None
            guess = result.T_field_base
        check = verify(a, b, guess, self._verification)
        innovation = se2.between(predicted, check.T_a_b)
        off = np.hypot(innovation[0], innovation[1])
        if not (check.loose or check.support) or off > radius + 0.3 or abs(innovation[2]) > angle + 0.1:
            return None
        return LocalClosure(earlier, later, check, innovation, radius)

    def _judge(self, found: list[LocalClosure], anchors: FloatArray) -> list[LocalClosure]:
        """Closures near their prediction hold at once; others wait until enough of them agree."""
        sure = [c for c in found if self._is_expected(c) or self._is_plain(c)]
        self._pending += [c for c in found if c not in sure and c.check.support]
        self._pending = [
            c for c in self._pending if self.places[-1].travel_m - self.places[c.later].travel_m < PENDING_M
        ]
        cluster = self._cluster(anchors)
        sure += cluster
        self._pending = [c for c in self._pending if c not in cluster]
        self._accepted += sure
        return sure

    @staticmethod
    def _is_expected(closure: LocalClosure) -> bool:
        """Near the prediction while little drift is to be allowed for."""
        return closure.check.loose and closure.slack_m <= NARROW_M

    @staticmethod
    def _is_plain(closure: LocalClosure) -> bool:
        """A wide closure that stands alone: informative, partial, and close to where it was expected."""
        worse = closure.check.worse
        near = closure.off_m < 0.3 * closure.slack_m + 0.2
        return closure.check.strict and closure.check.informative and worse.overlap > 0.4 and near

    def _cluster(self, anchors: FloatArray) -> list[LocalClosure]:
        """The pending closures that agree with the newest one, if they are enough."""
        if not self._pending:
            return []
        newest = self._pending[-1]
        agreeing = [c for c in self._pending if self._agree(c, newest, anchors)]
        spread = np.ptp([self.places[c.later].travel_m for c in agreeing])
        support = sum(c.check.support for c in agreeing)
        if support >= 3.0 and spread >= 3.0 and any(c.check.informative for c in agreeing):
            return agreeing
        return []

    def _agree(self, a: LocalClosure, b: LocalClosure, anchors: FloatArray) -> bool:
        """Whether going round both closures and the estimates between their ends leads back to the start."""
        earlier = se2.between(anchors[a.earlier], anchors[b.earlier])
        later = se2.between(anchors[a.later], anchors[b.later])
        round_trip = se2.compose(se2.compose(a.check.T_a_b, later), se2.inverse(b.check.T_a_b))
        rest = se2.between(earlier, round_trip)
        path = abs(self.places[a.later].travel_m - self.places[b.later].travel_m)
        path += float(np.hypot(earlier[0], earlier[1]))
        return bool(np.hypot(rest[0], rest[1]) < 0.25 + 0.02 * path and abs(rest[2]) < 0.05 + 0.002 * path)
