"""Revisits of places according to the ground truth, and the recall of closures over them.

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
from fcslam.metrics.closures import WITHIN_GAP_S, Recall, Rows, path_lengths, revisits_found
from fcslam.metrics.relations import PoseTable

EVERY_M: Final = 1.0
"""Path length between the poses that are tested."""
RADIUS_M: Final = 2.0
"""Largest distance of the other path."""


@dataclass(frozen=True, slots=True)
class Revisits:
    """Revisits: poses with the passes of one robot near them. A closure to any of the passes finds the revisit."""

    passes: Rows
    """Row of the pose and row of the nearest pose of a pass, shape (P, 2)."""
    numbers: NDArray[np.int64]
    """Number of the pass's revisit, shape (P,)."""

    def recall(self, correct: Rows, truth: PoseTable) -> Recall:
        """Recall of the ``correct`` closures (C, 2), with both ends within ``REACH_M`` of path length of a pass."""
        found = revisits_found(self.passes, correct, truth)
        return Recall(len(np.unique(self.numbers)), len(np.unique(self.numbers[found])))


def find_revisits(truth: PoseTable, between_robots: bool, turn_deg: float = 180.0) -> Revisits:
    """Find all revisits of other robots' paths, or of the robots' own paths.

    Args:
        truth: poses in one coordinate frame.
        between_robots: whether the paths are those of other robots.
        turn_deg: largest difference of the headings; 180: any.
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
    return Revisits(table[:, :2], table[:, 2])


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
