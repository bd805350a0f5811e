"""Loop closures against reference poses: how many are true, and how many revisits they find.

A reference knows motions between some of a run's poses. A closure ends at other poses, a little before or after; that
gap is bridged by the run's own trajectory, which over so short a time is as good as its odometry.
"""

from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from fcslam.geometry import se2
from fcslam.metrics.relations import PoseTable, motion_errors
from fcslam.records import FloatArray, frozen

Rows = NDArray[np.int64]
"""Rows of a run's pose table; -1 for none."""

Mask = NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class ClosureCriteria:
    """When a closure is covered, when it is wrong, and which revisit it finds."""

    bridge_s: float = 1.0
    """A closure's stamp and the reference's may lie this far apart."""
    wrong_m: float = 0.5
    """A covered closure that is off by more is wrong."""
    wrong_deg: float = 10.0
    """Or turned by more."""
    reach_m: float = 2.0
    """A closure finds a revisit if both ends lie this near along the robots' paths: the usual distance of places."""
    within_gap_s: float = 60.0
    """What lies nearer in time within one robot is no revisit."""


class ReferenceMotion(NamedTuple):
    """What a reference knows of the way between two poses."""

    a: int
    """Row of a pose near the first one."""
    b: int
    """Row of a pose near the second one."""
    T_a_b: FloatArray


class Reference(Protocol):
    """Something that knows motions between some of a run's poses."""

    def motion(self, i: int, j: int) -> ReferenceMotion | None:
        """The motion whose ends lie nearest in time to rows i and j, if it knows one near enough."""


@dataclass(frozen=True, slots=True)
class PoseReference:
    """Reference poses in components; poses of different components are not placed to each other."""

    run: PoseTable
    bridge_s: float
    rows: Rows
    """Where in the run the poses are, shape (M,)."""
    T_component_base: FloatArray
    """Shape (M, 3)."""
    components: NDArray[np.int64]
    """Shape (M,)."""

    def motion(self, i: int, j: int) -> ReferenceMotion | None:
        """As in Reference."""
        a, b = self._near(i), self._near(j)
        stamps = self.run.stamps
        away_s = np.abs(stamps[self.rows[a]] - stamps[i])[:, None] + np.abs(stamps[self.rows[b]] - stamps[j])
        away_s[self.components[a][:, None] != self.components[b]] = np.inf
        if not np.isfinite(away_s).any():
            return None
        best_a, best_b = np.unravel_index(np.argmin(away_s), away_s.shape)
        first, second = a[best_a], b[best_b]
        T_a_b = se2.between(self.T_component_base[first], self.T_component_base[second])
        return ReferenceMotion(int(self.rows[first]), int(self.rows[second]), T_a_b)

    def _near(self, row: int) -> NDArray[np.int64]:
        """Reference poses of the same robot at most ``bridge_s`` away."""
        away_s, robots = np.abs(self.run.stamps[self.rows] - self.run.stamps[row]), self.run.robots
        return np.flatnonzero((away_s <= self.bridge_s) & (robots[self.rows] == robots[row]))


class RelationReference:
    """Reference motions each for itself, in both directions: nothing is chained and nothing adjusted."""

    def __init__(self, run: PoseTable, bridge_s: float, ends: Rows, T_1_2: FloatArray) -> None:
        """``ends``, shape (R, 2), are the rows that the motions ``T_1_2``, shape (R, 3), join."""
        self._run, self._bridge_s = run, bridge_s
        self._ends = np.concatenate((ends, ends[:, ::-1]))
        self._T_a_b = np.concatenate((T_1_2, se2.inverse(T_1_2)))

    def motion(self, i: int, j: int) -> ReferenceMotion | None:
        """As in Reference."""
        stamps, robots = self._run.stamps, self._run.robots
        away_s = np.abs(stamps[self._ends] - stamps[[i, j]])
        near = np.flatnonzero(np.all((away_s <= self._bridge_s) & (robots[self._ends] == robots[[i, j]]), axis=1))
        if not len(near):
            return None
        best = near[np.argmin(away_s[near].sum(axis=1))]
        a, b = self._ends[best]
        return ReferenceMotion(int(a), int(b), self._T_a_b[best])


@dataclass(frozen=True, slots=True)
class ClosureErrors:
    """How far closures are off, one row each; NaN where no reference covers one."""

    ends: Rows
    """Rows of the reference poses that a closure was compared by, shape (K, 2); -1 where none covers it."""
    translation_m: FloatArray
    """Shape (K,)."""
    rotation_deg: FloatArray
    """Shape (K,)."""

    @property
    def covered(self) -> Mask:
        """Which closures the reference can judge, shape (K,)."""
        return np.isfinite(self.translation_m)

    def correct(self, criteria: ClosureCriteria) -> Mask:
        """Which of the covered ones are not wrong, shape (K,)."""
        return (self.translation_m <= criteria.wrong_m) & (self.rotation_deg <= criteria.wrong_deg)


def closure_errors(pairs: Rows, T_i_j: FloatArray, run: PoseTable, reference: Reference) -> ClosureErrors:
    """Errors of closures ``T_i_j`` (K, 3) between the rows ``pairs`` (K, 2) of ``run``."""
    ends = np.full((len(pairs), 2), -1, dtype=np.int64)
    true = np.full((len(pairs), 3), np.nan)
    for k, (i, j) in enumerate(pairs.tolist()):
        motion = reference.motion(i, j) if min(i, j) >= 0 else None
        if motion is not None:
            ends[k] = motion.a, motion.b
            T_i_a = se2.between(run.T_map_base[i], run.T_map_base[motion.a])
            T_b_j = se2.between(run.T_map_base[motion.b], run.T_map_base[j])
            true[k] = se2.compose(se2.compose(T_i_a, motion.T_a_b), T_b_j)
    return ClosureErrors(frozen(ends, np.int64), *motion_errors(true, T_i_j))


@dataclass(frozen=True, slots=True)
class Precision:
    """How many closures of a set are true, as far as the reference can tell."""

    closures: int
    covered: int
    wrong: int
    translation_m: tuple[float, float]
    """Median and maximum error of the covered ones; NaN for none."""
    rotation_deg: tuple[float, float]

    @property
    def coverage(self) -> float:
        """Share of the closures that the reference covers; NaN of none."""
        return _share(self.covered, self.closures)

    @property
    def precision(self) -> float:
        """Share of the covered closures that are not wrong; NaN of none."""
        return _share(self.covered - self.wrong, self.covered)


def precision(errors: ClosureErrors, members: Mask, criteria: ClosureCriteria) -> Precision:
    """Precision of the closures for which ``members``, shape (K,), holds."""
    judged = members & errors.covered
    wrong = judged & ~errors.correct(criteria)
    middle_and_most = [_median_and_maximum(spread[judged]) for spread in (errors.translation_m, errors.rotation_deg)]
    return Precision(int(members.sum()), int(judged.sum()), int(wrong.sum()), *middle_and_most)


@dataclass(frozen=True, slots=True)
class Recall:
    """How many of the revisits that a reference names are found."""

    revisits: int
    found: int

    @property
    def recall(self) -> float:
        """Share of the revisits that are found; NaN of none."""
        return _share(self.found, self.revisits)


def revisits_found(revisits: Rows, correct: Rows, run: PoseTable, reach_m: float) -> Mask:
    """Which revisits, pairs of rows (R, 2), a correct closure, one of the pairs (C, 2), finds: shape (R,).

    Both ends must lie within ``reach_m`` of path of the same robots; which end comes first does not matter.
    """
    metres, robots = path_lengths(run), run.robots
    both_ways = np.concatenate((correct, correct[:, ::-1]))
    found = np.zeros(len(revisits), dtype=np.bool_)
    for k, ends in enumerate(revisits):
        near = np.abs(metres[both_ways] - metres[ends]) <= reach_m
        found[k] = np.any(np.all(near & (robots[both_ways] == robots[ends]), axis=1))
    return found


def path_lengths(run: PoseTable) -> FloatArray:
    """How far each pose's robot had driven, metres, shape (M,): the polygon through its poses in the stamps' order."""
    metres = np.zeros(len(run.stamps))
    for robot in np.unique(run.robots):
        rows = np.flatnonzero(run.robots == robot)
        steps = np.diff(run.T_map_base[rows, :2], axis=0)
        metres[rows[1:]] = np.cumsum(np.hypot(steps[:, 0], steps[:, 1]))
    return metres


def _median_and_maximum(values: FloatArray) -> tuple[float, float]:
    return (float(np.median(values)), float(np.max(values))) if len(values) else (np.nan, np.nan)


def _share(part: int, whole: int) -> float:
    return part / whole if whole else np.nan
