"""Loop closing inside one robot: a submap is compared with earlier ones that may show the same place.

The error allowed for in the estimate grows with the shortest path through the pose graph (odometry and accepted
closures), not with time: after a closure the search is narrow again. A wide search covers the whole window by branch
and bound. Beyond the largest window, place recognition proposes submaps and motions.
"""

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from itertools import islice
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fcslam.compiled import njit
from fcslam.geometry import se2
from fcslam.geometry.thinning import surplus_places
from fcslam.graph.cluster import maximum_clique
from fcslam.lidar.correlative import SearchWindow, search
from fcslam.lidar.submap import Submap, read_submap, submap_bytes
from fcslam.lidar.verification import ALIGNMENT_SCALE_M, SYMMETRY_M, SYMMETRY_RAD, Verification, verify
from fcslam.records import FloatArray

NARROW_M = 2.0 * ALIGNMENT_SCALE_M
"""Up to this drift allowance the prediction itself starts the alignment, and the loose gate is enough."""
DISTANCE_PENALTY = 0.2
ANGLE_PENALTY = 0.5 * DISTANCE_PENALTY
"""Shares of a search's score lost at the edges of its window: of equal poses, the one near the prediction counts."""
PENDING_M = 60.0
"""Travel after which a pending closure without enough support is dropped, metres."""

BASE_DRIFT_M, BASE_DRIFT_RAD = 0.3, 0.05
"""Drift allowance at zero path length: the errors of the two submaps themselves."""
DRIFT_M_M = 0.03
DRIFT_RAD_M = 0.2 * DRIFT_M_M
"""Drift of the position and the heading allowed for, per metre of path through the graph: metres, and radians."""
ALIGNMENT_MARGIN_M, ALIGNMENT_MARGIN_RAD = BASE_DRIFT_M, 2.0 * BASE_DRIFT_RAD
"""The refined alignment may lie this far outside the search window."""
CLOSURE_PATH_M = 1.0
"""Path length that crossing an accepted closure counts as, metres: a closure is not exact."""

CONCLUSIVE_OVERLAP = 0.4
"""Least overlap of two submaps that decides alone: of a closure that is accepted after a wide search without support,
nearer to its prediction than to the edge of the drift allowance, and of a robot that leaves a cabin."""
MINIMUM_SUPPORT = 3.0
"""Sum of ``Verification.support`` that consistent pending closures need."""
MINIMUM_SPREAD_M = MINIMUM_SUPPORT
"""Travel over which they are spread at least, a metre each: closures from one place are one piece of evidence."""
MOST_NEARBY, NEARBY_M = 10, 2.0
"""Most submaps kept for comparison in a square of the map, of this side in metres; beyond, the oldest is forgotten."""
SIGHT_M = 8.0
"""Largest distance between the anchors of two submaps that are compared, besides the drift allowance; farther ones
overlap too little, metres."""
LEAST_GAP_M = 1.5 * SIGHT_M
"""Least travel between the anchors of two submaps that are compared, metres."""
MOST_CANDIDATES = 4
"""Most earlier visits that a submap is compared with; one closure ties it to a square of over ``MOST_NEARBY``."""
UNPACKED = 16 * MOST_CANDIDATES
"""Submaps that are kept ready for comparison, 0.2 MB each."""
SIMILAR_PLACES = 6 * MOST_CANDIDATES
"""Most similar earlier submaps among which the places to compare are chosen."""
WIDEST_M, WIDEST_RAD = 15.0, 0.7
"""Largest half side and half angle of the search window, metres and radians."""
RECOGNIZED_DRIFT = 0.25
"""Largest drift, metres per metre of path through the graph, at which place recognition closes loops out of reach."""


@dataclass(frozen=True, slots=True, eq=False)
class LocalClosure:
    """A verified closure between the anchors of two submaps of one robot (indices into ``LoopCloser.keyscans``)."""

    earlier: int
    later: int
    check: Verification
    innovation: FloatArray
    """Measurement relative to the prediction (x, y, theta), shape (3,), metres and radians."""
    drift_m: float
    """Drift allowance when the closure was found, metres."""
    beyond_search: bool = False
    """Whether it is farther from its prediction than that, so that only place recognition finds it."""

    @property
    def innovation_m(self) -> float:
        """Distance between measurement and prediction, metres."""
        return float(np.hypot(self.innovation[0], self.innovation[1]))

    @property
    def is_surprising(self) -> bool:
        """Whether it contradicts the estimate, so that the graph is solved at once."""
        return self.innovation_m > SYMMETRY_M or abs(self.innovation[2]) > SYMMETRY_RAD


class PlaceRecognizer(Protocol):
    """Recognises the places of one robot by their looks. Submaps are named by the keyscan of their anchor."""

    def store(self, keyscan: int, surface: FloatArray) -> None:
        """Store a submap by the points of its surfaces in the anchor's base, shape (N, 2), metres."""

    def most_similar(self, keyscan: int, among: Collection[int], most: int) -> list[int]:
        """At most ``most`` of these stored submaps that look like a stored one, the most similar first."""

    def forget(self, keyscan: int) -> None:
        """Forget a stored submap."""

    def motions(self, a: int, b: int) -> list[FloatArray]:
        """Motions ``T_a_b``, shape (3,), that the keypoints of two stored submaps support, the best first."""


class LoopCloser:
    """Collects the submaps of one robot and decides which closures between them are accepted."""

    def __init__(self, recognizer: PlaceRecognizer | None = None) -> None:
        self._recognizer = recognizer
        self.keyscans: list[int] = []
        """Number of the anchor of each submap so far."""
        self._travel = np.empty(0)
        """Path length up to each of them, metres (turns count a little)."""
        self._held: dict[int, Submap | bytes] = {}
        """The submaps that others are compared with, by index, in the order of their use; all but the last are packed.
        The oldest of a well-known area are forgotten."""
        self._accepted: list[tuple[int, int]] = []
        """Earlier and later submap of each accepted closure."""
        self._fixed: list[tuple[int, int]] = []
        """Those that fix every direction: the others leave the drift along a corridor as it was."""
        self._pending: list[LocalClosure] = []

    @property
    def has_closures(self) -> bool:
        """Whether any closure was accepted."""
        return bool(self._accepted)

    def add(self, keyscan: int, travel_m: float, submap: Submap, anchors: FloatArray) -> list[LocalClosure]:
        """Compare the next submap, its anchor's number and the path length up to there with earlier ones.

        ``anchors`` are the poses of the anchors of all submaps with this one, shape (S, 3). Returns the closures that
        are accepted now: of this submap, and pending ones that it supports.
        """
        later = len(self.keyscans)
        self.keyscans.append(keyscan)
        self._travel = np.append(self._travel, travel_m)
        self._held[later] = submap
        for index in list(self._held)[:-UNPACKED]:
            if isinstance(held := self._held[index], Submap):
                self._held[index] = submap_bytes(held)
        is_known = self._forget_surplus(anchors)
        near, paths = self._paths(self._accepted), self._paths(self._fixed)
        candidates = self._candidates(later, anchors, paths)[: 1 if is_known else MOST_CANDIDATES]
        found: list[LocalClosure] = []
        for earlier in candidates:
            lengths_m = dict.fromkeys((near[earlier], paths[earlier]))  # mostly the same
            compared = (self._compare(earlier, later, anchors, length_m) for length_m in lengths_m)
            found += islice(filter(None, compared), 1)
        accepted = [c for c in found if (c.check.loose and c.drift_m <= NARROW_M) or self._is_conclusive(c)]
        unsure = [c for c in found if c not in accepted]
        if self._recognizer is not None:
            self._recognizer.store(keyscan, self._submap(later).surface.points)
            if not accepted:
                known = {c.earlier for c in found}
                recognized = self._recognized(self._recognizer, later, anchors, paths)
                unsure += [c for c in recognized if c.earlier not in known]
        return self._accept(accepted, unsure, anchors)

    def _paths(self, closures: list[tuple[int, int]]) -> FloatArray:
        """Length of the shortest path to each submap through the odometry and these closures, shape (S,), metres."""
        edges = np.array(closures, dtype=np.int64).reshape(-1, 2)
        paths: FloatArray = _shortest_paths(len(self._travel) - 1, np.diff(self._travel), edges, CLOSURE_PATH_M)
        return paths

    def _submap(self, index: int) -> Submap:
        held = self._held.pop(index)
        self._held[index] = submap = read_submap(held) if isinstance(held, bytes) else held
        return submap

    def _forget_surplus(self, anchors: FloatArray) -> bool:
        held = np.sort(list(self._held))
        surplus = surplus_places(anchors[held, :2], NEARBY_M, MOST_NEARBY)
        for row in surplus:
            index = int(held[row])
            del self._held[index]
            if self._recognizer is not None:
                self._recognizer.forget(self.keyscans[index])
        return len(surplus) > 0

    def _comparable(self, later: int) -> NDArray[np.bool_]:
        """Submaps that are held and far enough before a later one on the path, shape (S,)."""
        held = np.zeros(len(self.keyscans), np.bool_)
        held[list(self._held)] = True
        held &= self._travel[later] - self._travel > LEAST_GAP_M
        return held

    def _candidates(self, later: int, anchors: FloatArray, paths: FloatArray) -> list[int]:
        distance = np.hypot(*(anchors[:, :2] - anchors[later, :2]).T)
        indices = np.flatnonzero((distance < SIGHT_M + drift_allowance(paths)[:, 0]) & self._comparable(later))
        if not len(indices):
            return []
        visits = np.split(indices, np.flatnonzero(np.diff(indices) > 1) + 1)
        best = (int(visit[np.argmin(distance[visit])]) for visit in visits)
        return sorted(best, key=lambda k: distance[k])

    def _compare(
        self, earlier: int, later: int, anchors: FloatArray, path_m: float, recognized: FloatArray | None = None
    ) -> LocalClosure | None:
        """Verify a closure where it is ``recognized``, or where a search finds it if the drift allowance is wide.

        None if the submaps do not show the same place, or if no drift explains where it is.
        """
        a, b = self._submap(earlier), self._submap(later)
        guess = predicted = se2.between(anchors[earlier], anchors[later])
        radius, angle = drift_allowance(path_m).tolist()
        if recognized is not None:
            guess = recognized
        elif radius > NARROW_M:
            window = SearchWindow(radius, angle, DISTANCE_PENALTY, ANGLE_PENALTY)
            guess, _ = search(b.surface, a.field, predicted, window)
        check = verify(a, b, guess)
        innovation = se2.between(predicted, check.T_a_b)
        off_m, off_rad = float(np.hypot(innovation[0], innovation[1])), abs(float(innovation[2]))
        if recognized is None:
            is_explained = off_m <= radius + ALIGNMENT_MARGIN_M and off_rad <= angle + ALIGNMENT_MARGIN_RAD
        else:
            is_explained = off_m <= RECOGNIZED_DRIFT * path_m
        if not (check.loose or check.support) or not is_explained:
            return None
        beyond = recognized is not None and (off_m > radius or off_rad > angle)
        return LocalClosure(earlier, later, check, innovation, radius, beyond)

    def _recognized(
        self, recognizer: PlaceRecognizer, later: int, anchors: FloatArray, paths: FloatArray
    ) -> list[LocalClosure]:
        """The best closure that place recognition proposes beyond the search's reach.

        Nothing predicts it, so a submap that fits two parts of the map proves neither, and gives none.
        """
        found = [
            closure
            for earlier in self._lookalikes(recognizer, later, anchors, paths)
            for guess in recognizer.motions(self.keyscans[earlier], self.keyscans[later])
            if (closure := self._compare(earlier, later, anchors, paths[earlier], guess)) is not None
        ]
        if len(found) > 1 and not consistency(found, self._travel, anchors).all():
            return []
        return sorted(found, key=lambda c: (c.check.support, c.check.worse.overlap))[-1:]

    def _lookalikes(self, recognizer: PlaceRecognizer, later: int, anchors: FloatArray, paths: FloatArray) -> list[int]:
        travel = self._travel
        distance = np.hypot(*(anchors[:, :2] - anchors[later, :2]).T)
        drift = drift_allowance(paths)
        capped = (drift >= (WIDEST_M, WIDEST_RAD)).any(axis=1)
        unsure = capped | (distance > SIGHT_M + drift[:, 0])
        possible = distance < SIGHT_M + RECOGNIZED_DRIFT * paths
        eligible = np.flatnonzero(unsure & possible & self._comparable(later))
        number = {self.keyscans[k]: int(k) for k in eligible}
        chosen: list[int] = []
        for keyscan in recognizer.most_similar(self.keyscans[later], number, SIMILAR_PLACES) if number else ():
            k = number[keyscan]
            if all(abs(travel[k] - travel[other]) > SIGHT_M for other in chosen):
                chosen.append(k)
        return chosen[:MOST_CANDIDATES]

    def _accept(
        self, accepted: list[LocalClosure], unsure: list[LocalClosure], anchors: FloatArray
    ) -> list[LocalClosure]:
        self._pending += [c for c in unsure if c.check.support]
        self._pending = [c for c in self._pending if self._travel[-1] - self._travel[c.later] < PENDING_M]
        cluster = supported(self._pending, self._travel, anchors)
        accepted += cluster
        self._pending = [c for c in self._pending if c not in cluster]
        self._accepted += [(c.earlier, c.later) for c in accepted]
        self._fixed += [(c.earlier, c.later) for c in accepted if c.check.informative]
        return accepted

    @staticmethod
    def _is_conclusive(closure: LocalClosure) -> bool:
        overlap = closure.check.worse.overlap
        near = 2.0 * closure.innovation_m < closure.drift_m
        return closure.check.strict and closure.check.informative and overlap > CONCLUSIVE_OVERLAP and near


def drift_allowance(path_m: ArrayLike) -> FloatArray:
    """Error of the estimate allowed for after paths (...) through the graph: metres and radians, (..., 2)."""
    path = np.asarray(path_m)[..., None]
    allowed = np.array((BASE_DRIFT_M, BASE_DRIFT_RAD)) + np.array((DRIFT_M_M, DRIFT_RAD_M)) * path
    return np.asarray(np.minimum((WIDEST_M, WIDEST_RAD), allowed))


def supported(pending: Sequence[LocalClosure], travel: FloatArray, anchors: FloatArray) -> list[LocalClosure]:
    """The closures that support each other enough to be accepted, whatever their order.

    A cluster is a closure with the most others that are consistent with it and with one another. If several are large
    enough, the one with the most support counts; of equal ones, the latest. ``travel`` (S,) is the path length up to
    each submap, and ``anchors`` (S, 3) are the poses of their anchors.
    """
    if len(pending) < MINIMUM_SUPPORT:
        return []
    consistent = consistency(pending, travel, anchors)
    best: tuple[float, list[LocalClosure]] = 0.0, []
    for row in consistent[::-1]:
        near = np.flatnonzero(row)
        cluster = [pending[near[k]] for k in maximum_clique(consistent[np.ix_(near, near)])[0]]
        support = sum(c.check.support for c in cluster)
        is_spread = np.ptp(travel[[c.later for c in cluster]]) >= MINIMUM_SPREAD_M
        informative = any(c.check.informative for c in cluster)
        if support >= MINIMUM_SUPPORT and is_spread and informative and support > best[0]:
            best = support, cluster
    return best[1]


def consistency(closures: Sequence[LocalClosure], travel: FloatArray, anchors: FloatArray) -> NDArray[np.bool_]:
    """Whether the loop over two closures and the estimated motions between their ends closes, shape (C, C).

    It must close within the drift allowed for on the path in it, whichever of the two it is driven from.

    Arguments as for ``supported``.
    """
    ends = np.array([(c.earlier, c.later) for c in closures], dtype=np.int64).reshape(-1, 2)
    T_a_b = np.array([c.check.T_a_b for c in closures]).reshape(-1, 1, 3)
    T_earlier, T_later = anchors[ends[:, 0]], anchors[ends[:, 1]]
    earlier = se2.between(T_earlier[:, None], T_earlier[None])
    later = se2.between(T_later[:, None], T_later[None])
    round_trip = se2.compose(se2.compose(T_a_b, later), se2.inverse(T_a_b[:, 0])[None])
    residual = se2.between(earlier, round_trip)
    between_later_m = np.abs(np.subtract.outer(travel[ends[:, 1]], travel[ends[:, 1]]))
    path_m = between_later_m + np.hypot(earlier[..., 0], earlier[..., 1])
    off = np.stack((np.hypot(residual[..., 0], residual[..., 1]), np.abs(residual[..., 2])), axis=-1)
    closes = (off < drift_allowance(path_m)).all(axis=-1)
    return np.asarray(closes & closes.T)


@njit
def _shortest_paths(source, steps, closures, closure_m):  # type: ignore[no-untyped-def]
    """Shortest paths (S,) from a vertex of a chain with ``steps`` (S - 1,) between its vertices and closures (K, 2).

    Bellman-Ford, a sweep along the chain and back each time: a path crosses few closures, so few sweeps are enough.
    """
    paths = np.full(len(steps) + 1, np.inf)
    paths[source] = 0.0
    changed = True
    while changed:
        changed = False
        for k in range(len(steps)):
            paths[k + 1] = min(paths[k + 1], paths[k] + steps[k])
        for k in range(len(steps) - 1, -1, -1):
            paths[k] = min(paths[k], paths[k + 1] + steps[k])
        for k in range(len(closures)):
            i, j = closures[k, 0], closures[k, 1]
            if paths[i] + closure_m < paths[j] or paths[j] + closure_m < paths[i]:
                paths[i], paths[j] = min(paths[i], paths[j] + closure_m), min(paths[j], paths[i] + closure_m)
                changed = True
    return paths
