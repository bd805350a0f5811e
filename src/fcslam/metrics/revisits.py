"""Where the truth says that robots came to places again, and how many of these revisits closures find.

A revisit is asked of positions alone, so that it is the same question to every sensor: at a pose of robot a, had robot
b been, or will it be, near by? A camera sees the same only if the headings are alike, so revisits can be asked for with
like headings as well. What walls stand between is not asked.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fcslam.geometry import se2
from fcslam.metrics.closures import Recall, Rows, path_lengths, revisits_found
from fcslam.metrics.relations import PoseTable


@dataclass(frozen=True, slots=True)
class RevisitCriteria:
    """What counts as a revisit."""

    every_m: float = 1.0
    """Poses asked about lie this far apart along the path."""
    radius_m: float = 2.0
    """The other path passes within it."""
    turn_deg: float = 180.0
    """Headings differ by no more; 180: any."""
    within_gap_s: float = 60.0
    """Within one robot, the other pass is further away in time."""


@dataclass(frozen=True, slots=True)
class Revisits:
    """Poses of robots, each with the passes of one robot near it; to find one of several passes is enough."""

    passes: Rows
    """Row of the pose, row of the nearest pose of a pass: shape (P, 2)."""
    numbers: NDArray[np.int64]
    """Number of the revisit that the pass belongs to, shape (P,)."""

    def recall(self, correct: Rows, truth: PoseTable, reach_m: float) -> Recall:
        """How many revisits the ``correct`` closures (C, 2) find: both ends within ``reach_m`` of path of a pass."""
        found = revisits_found(self.passes, correct, truth, reach_m)
        return Recall(len(np.unique(self.numbers)), len(np.unique(self.numbers[found])))


def find_revisits(truth: PoseTable, criteria: RevisitCriteria, between_robots: bool) -> Revisits:
    """All revisits of other robots' paths, or of the robots' own; ``truth`` is in one frame."""
    robots = np.unique(truth.robots).tolist()
    pairs = [(a, b) for a in robots for b in robots if (a != b) == between_robots]
    rows_of = {robot: np.flatnonzero(truth.robots == robot) for robot in robots}
    asked_of = {robot: _sampled(rows_of[robot], path_lengths(truth), criteria.every_m) for robot in robots}
    asked = [(row, rows_of[b]) for a, b in pairs for row in asked_of[a].tolist()]
    found = [
        (row, nearest, number)
        for number, (row, others) in enumerate(asked)
        for nearest in _passes(row, others, truth, criteria)
    ]
    table = np.array(found, dtype=np.int64).reshape(-1, 3)
    return Revisits(table[:, :2], table[:, 2])


def _sampled(rows: NDArray[np.int64], metres: NDArray[np.float64], every_m: float) -> NDArray[np.int64]:
    """Rows of one robot about ``every_m`` of path apart, its first among them."""
    lengths = metres[rows]
    at = np.searchsorted(lengths, np.arange(0.0, lengths[-1] + 1e-9, every_m))
    return rows[np.unique(np.minimum(at, len(rows) - 1))]


def _passes(row: int, others: NDArray[np.int64], truth: PoseTable, criteria: RevisitCriteria) -> Iterator[int]:
    """The nearest pose of each stretch of path, rows ``others``, that passes the pose ``row``."""
    away = truth.T_map_base[others] - truth.T_map_base[row]
    distance = np.hypot(away[:, 0], away[:, 1])
    near = (distance <= criteria.radius_m) & (np.abs(se2.wrap_angle(away[:, 2])) <= np.radians(criteria.turn_deg))
    if truth.robots[row] == truth.robots[others[0]]:
        near &= np.abs(truth.stamps[others] - truth.stamps[row]) > criteria.within_gap_s
    places = np.flatnonzero(near)
    for stretch in np.split(places, np.flatnonzero(np.diff(places) > 1) + 1):
        if len(stretch):
            yield int(others[stretch[np.argmin(distance[stretch])]])
