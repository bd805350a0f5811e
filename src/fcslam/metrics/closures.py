"""Precision and recall of loop closures against reference poses.

A reference has relative poses between some of a run's poses. The ends of a closure are other poses, shortly before or
after. The run's own trajectory bridges this gap; over such a short time it is as accurate as odometry.
"""

from dataclasses import dataclass
from typing import Final, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from fcslam.geometry import se2
from fcslam.metrics.relations import PoseTable, motion_errors
from fcslam.records import FloatArray, frozen

Rows = NDArray[np.int64]
"""Rows of a run's pose table; -1 for none."""

Mask = NDArray[np.bool_]
"""Selection, shape (K,) for K closures."""


BRIDGE_S: Final = 1.0
"""Largest time between an end of a closure and a reference pose that covers it."""
WRONG_M: Final = 0.5
"""A covered closure with a larger translation error is wrong."""
WRONG_DEG: Final = 10.0
"""A covered closure with a larger rotation error is wrong."""
REACH_M: Final = 2.0
"""A closure finds a revisit if both ends are within this path length of it: the spacing of places."""
WITHIN_GAP_S: Final = 60.0
"""Shortest time between two passes of one robot that count as a revisit."""


class ReferenceMotion(NamedTuple):
    """A relative pose of a reference, near two poses of a run."""

    a: int
    """Row of the reference pose near the first pose."""
    b: int
    """Row of the reference pose near the second pose."""
    T_a_b: FloatArray
    """Shape (3,)."""


class Reference(Protocol):
    """A source of true relative poses between some of a run's poses."""

    def motion(self, i: int, j: int) -> ReferenceMotion | None:
        """The relative pose whose ends are nearest in time to rows i and j; None if none is near enough."""


@dataclass(frozen=True, slots=True)
class PoseReference:
    """Reference poses in components; relative poses are only known within a component."""

    run: PoseTable
    bridge_s: float
    rows: Rows
    """Rows of the reference poses in the run, shape (M,)."""
    T_component_base: FloatArray
    """Reference poses in the frame of their component, shape (M, 3)."""
    components: NDArray[np.int64]
    """Component of each pose, shape (M,)."""

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


@dataclass(frozen=True, slots=True)
class ClosureErrors:
    """Errors of closures, one row each; NaN without a reference."""

    ends: Rows
    """Rows of the reference poses that a closure was compared with, shape (K, 2); -1 without a reference."""
    translation_m: FloatArray
    """Shape (K,)."""
    rotation_deg: FloatArray
    """Shape (K,)."""

    @property
    def covered(self) -> Mask:
        """Closures with a reference, shape (K,)."""
        return np.isfinite(self.translation_m)

    @property
    def correct(self) -> Mask:
        """Covered closures that are not wrong, shape (K,)."""
        return (self.translation_m <= WRONG_M) & (self.rotation_deg <= WRONG_DEG)


def closure_errors(pairs: Rows, T_i_j: FloatArray, run: PoseTable, reference: Reference) -> ClosureErrors:
    """Errors of closures ``T_i_j`` (K, 3), metres and radians, between rows ``pairs`` (K, 2) of ``run``."""
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
    """Precision of a set of closures, as far as the reference covers it."""

    closures: int
    covered: int
    wrong: int
    translation_m: tuple[float, float]
    """Median and maximum error of the covered closures; NaN for none."""
    rotation_deg: tuple[float, float]
    """Median and maximum error of the covered closures; NaN for none."""

    @property
    def coverage(self) -> float:
        """Share of the closures that the reference covers; NaN without closures."""
        return _share(self.covered, self.closures)

    @property
    def precision(self) -> float:
        """Share of the covered closures that are not wrong; NaN without covered closures."""
        return _share(self.covered - self.wrong, self.covered)


def precision(errors: ClosureErrors, members: Mask) -> Precision:
    """Precision of the closures selected by ``members``, shape (K,)."""
    judged = members & errors.covered
    wrong = judged & ~errors.correct
    middle_and_most = [_median_and_maximum(spread[judged]) for spread in (errors.translation_m, errors.rotation_deg)]
    return Precision(int(members.sum()), int(judged.sum()), int(wrong.sum()), *middle_and_most)


@dataclass(frozen=True, slots=True)
class Recall:
    """Recall of closures over the revisits of a reference."""

    revisits: int
    found: int

    @property
    def recall(self) -> float:
        """Share of the revisits that are found; NaN without revisits."""
        return _share(self.found, self.revisits)


def revisits_found(revisits: Rows, correct: Rows, run: PoseTable) -> Mask:
    """Find which revisits are detected by a correct closure.

    Args:
        revisits: pairs of rows of ``run``, shape (R, 2).
        correct: ends of the correct closures as pairs of rows, shape (C, 2), in either order.
        run: poses of the run.

    Returns:
        Shape (R,).
    """
    metres, robots = path_lengths(run), run.robots
    both_ways = np.concatenate((correct, correct[:, ::-1]))
    found = np.zeros(len(revisits), dtype=np.bool_)
    for k, ends in enumerate(revisits):
        near = np.abs(metres[both_ways] - metres[ends]) <= REACH_M
        found[k] = np.any(np.all(near & (robots[both_ways] == robots[ends]), axis=1))
    return found


def path_lengths(run: PoseTable) -> FloatArray:
    """Path length of each pose's robot up to the pose, metres, shape (M,): polyline in the order of stamps."""
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
