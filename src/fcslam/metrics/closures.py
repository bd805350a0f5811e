"""Precision and recall of loop closures: by their errors against a reference, and over the revisits of a ground truth.

A revisit depends on positions only, so that it is the same for every sensor: robot b passes near a pose of robot a,
before or after. A camera sees the same scene only from similar headings, so revisits can also be limited to those.
Walls in between are ignored.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from fcslam.geometry import se2
from fcslam.metrics.relations import PoseTable
from fcslam.records import FloatArray

Rows = NDArray[np.int64]
"""Rows of a run's pose table; -1 for none."""

Mask = NDArray[np.bool_]
"""Selection, shape (K,) for K closures."""

WRONG_M: Final = 0.5
"""A covered closure with a larger translation error is wrong."""
WRONG_DEG: Final = 10.0
"""A covered closure with a larger rotation error is wrong."""
REACH_M: Final = 2.0
"""A closure finds a revisit if both ends are within this path length of it: the spacing of places."""
WITHIN_GAP_S: Final = 60.0
"""Shortest time between two passes of one robot that count as a revisit."""
EVERY_M: Final = 0.5 * REACH_M
"""Path length between the poses that are tested."""
RADIUS_M: Final = REACH_M
"""Largest distance of the other path."""


@dataclass(frozen=True, slots=True)
class ClosureErrors:
    """Errors of closures, one row each; NaN without a reference."""

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
    """Which revisits are detected by a correct closure, shape (R,).

    Revisits (R, 2) and correct closures (C, 2), whose ends are in either order, are pairs of rows of ``run``.
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


Revisits = tuple[Rows, NDArray[np.int64]]
"""Revisits: poses with the passes of one robot near them. A closure to any of the passes finds the revisit.

Row of the pose and row of the nearest pose of a pass, shape (P, 2); and number of the pass's revisit, shape (P,).
"""


def recall_of(revisits: Revisits, correct: Rows, truth: PoseTable) -> Recall:
    """Recall of the ``correct`` closures (C, 2), with both ends within ``REACH_M`` of path length of a pass."""
    passes, numbers = revisits
    found = revisits_found(passes, correct, truth)
    return Recall(len(np.unique(numbers)), len(np.unique(numbers[found])))


def find_revisits(truth: PoseTable, between_robots: bool, turn_deg: float = 180.0) -> Revisits:
    """Find all revisits of other robots' paths, or of the robots' own paths.

    ``turn_deg`` is the largest difference of the headings; 180: any.
    """
    robots = np.unique(truth.robots).tolist()
    pairs = [(a, b) for a in robots for b in robots if (a != b) == between_robots]
    rows_of = {robot: np.flatnonzero(truth.robots == robot) for robot in robots}
    asked_of = {robot: _sampled(rows_of[robot], path_lengths(truth), EVERY_M) for robot in robots}
    asked = [(row, rows_of[b]) for a, b in pairs for row in asked_of[a].tolist()]
    found = [
        (row, nearest, number)
        for number, (row, others) in enumerate(asked)
        for nearest in _passes(row, others, truth, turn_deg)
    ]
    table = np.array(found, dtype=np.int64).reshape(-1, 3)
    return table[:, :2], table[:, 2]


def _sampled(rows: NDArray[np.int64], metres: NDArray[np.float64], every_m: float) -> NDArray[np.int64]:
    """Select rows of one robot about ``every_m`` of path length apart, starting with the first: shape (S,)."""
    lengths = metres[rows]
    at = np.searchsorted(lengths, np.arange(0.0, lengths[-1] + 1e-9, every_m))
    sampled: NDArray[np.int64] = rows[np.unique(np.minimum(at, len(rows) - 1))]
    return sampled


def _passes(row: int, others: NDArray[np.int64], truth: PoseTable, turn_deg: float) -> Iterator[int]:
    """Row of the nearest pose of each pass of the path ``others`` (M,) near the pose ``row``."""
    away = truth.T_map_base[others] - truth.T_map_base[row]
    distance = np.hypot(away[:, 0], away[:, 1])
    near = (distance <= RADIUS_M) & (np.abs(se2.wrap_angle(away[:, 2])) <= np.radians(turn_deg))
    if truth.robots[row] == truth.robots[others[0]]:
        near &= np.abs(truth.stamps[others] - truth.stamps[row]) > WITHIN_GAP_S
    places = np.flatnonzero(near)
    for stretch in np.split(places, np.flatnonzero(np.diff(places) > 1) + 1):
        if len(stretch):
            yield int(others[stretch[np.argmin(distance[stretch])]])
