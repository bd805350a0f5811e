"""Errors of trajectories: absolute and relative ones against the ground truth, and jumps, which need no truth.

The truth has one coordinate frame, ``truth``; the estimate has a frame ``map`` for each map. The absolute trajectory
error (ATE) is computed after aligning a whole map with *one* rigid motion, so it includes errors between robots.
J. Sturm et al., "A Benchmark for the Evaluation of RGB-D SLAM Systems", IROS 2012, without scale. An alignment contains
no reflection, so a mirrored map has a large error.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fcslam.geometry import se2
from fcslam.geometry.alignment import n_point_alignment
from fcslam.metrics.relations import PoseTable, RelationErrors, motion_errors
from fcslam.records import SAME_STAMP_S, FloatArray

LARGEST_SPEED_M_S = 3.0
LARGEST_TURN_RAD_S = 4.0
"""A faster step is a jump."""
SLACK_M = 0.2
"""Length allowed to any step, metres: the optimized map corrects by small steps."""
SLACK_RAD = 0.3
"""Turn allowed to any step, radians."""


@dataclass(frozen=True, slots=True)
class PositionErrors:
    """Statistics of position errors in metres; all NaN without positions."""

    rmse_m: float
    mean_m: float
    max_m: float

    @classmethod
    def of(cls, errors_m: FloatArray) -> "PositionErrors":
        """Statistics of the distances ``errors_m``, shape (N,)."""
        if not len(errors_m):
            return cls(np.nan, np.nan, np.nan)
        return cls(float(np.sqrt(np.mean(errors_m**2))), float(np.mean(errors_m)), float(np.max(errors_m)))


def interpolate(stamps: FloatArray, T: FloatArray, wanted: FloatArray, gap_s: float) -> FloatArray:
    """Interpolate poses linearly in position and heading.

    Args:
        stamps: stamps of the known poses, shape (N,), seconds, in any order.
        T: known poses, shape (N, 3).
        wanted: stamps to interpolate at, shape (K,), seconds.
        gap_s: largest time between two known poses.

    Returns:
        Shape (K, 3); NaN in gaps longer than ``gap_s``, before the first and after the last known pose.
    """
    order = np.argsort(stamps, kind="stable")
    known, poses = stamps[order], T[order]
    channels = (poses[:, 0], poses[:, 1], np.unwrap(poses[:, 2]))
    result = np.column_stack([np.interp(wanted, known, channel) for channel in channels])
    result[:, 2] = se2.wrap_angle(result[:, 2])
    right = np.clip(np.searchsorted(known, wanted), 1, max(len(known) - 1, 1))
    before, after = known[right - 1], known[np.minimum(right, len(known) - 1)]
    on_one = np.minimum(np.abs(wanted - before), np.abs(wanted - after)) <= SAME_STAMP_S
    between = (before <= wanted) & (wanted <= after) & (after - before <= gap_s)
    result[~(on_one | between)] = np.nan
    return result


def align(T_truth_base: FloatArray, T_map_base: FloatArray) -> FloatArray:
    """``T_truth_map`` (3,) that aligns positions by least squares (Umeyama 1991, without scale).

    The true and the estimated poses (N, 3) have the same stamps. NaN if the robots did not move, because positions then
    determine no rotation.
    """
    return n_point_alignment(T_truth_base[:, :2], T_map_base[:, :2])


def position_errors(T_truth_map: FloatArray, T_truth_base: FloatArray, T_map_base: FloatArray) -> FloatArray:
    """Distances (N,) in metres between true positions and estimated positions after alignment.

    The alignment has shape (3,), the poses at the same stamps (N, 3).
    """
    moved = se2.transform(T_truth_map, T_map_base[:, :2])
    distances: FloatArray = np.linalg.norm(moved - T_truth_base[:, :2], axis=-1)
    return distances


TrajectoryPair = tuple[FloatArray, FloatArray]
"""True and estimated poses of one robot at the same stamps, shape (N, 3) each."""


def _alignment(pair: TrajectoryPair) -> FloatArray:
    """``T_truth_map`` (3,) from positions and headings, so that it is defined for a robot that stands still."""
    return n_point_alignment(*(np.concatenate((T[:, :2], se2.compose(T, (1.0, 0.0, 0.0))[:, :2])) for T in pair))


def placement_error(a: TrajectoryPair, b: TrajectoryPair) -> tuple[float, float]:
    """Relative error of two robots in one map: metres and degrees.

    The trajectory of each robot alone gives an alignment of the map with the truth. The error is the difference between
    both alignments, with the translation measured at the centroid of both trajectories.
    """
    off = se2.between(_alignment(a), _alignment(b))
    middle = np.concatenate((a[1], b[1]))[:, :2].mean(axis=0)
    shift = se2.transform(off, middle[None])[0] - middle
    return float(np.hypot(*shift)), float(np.degrees(np.abs(off[2])))


def near_pairs(
    truth: PoseTable, rng: np.random.Generator, across_robots: bool, count: int = 2000, reach_m: float = 5.0
) -> NDArray[np.int64]:
    """Up to ``count`` random pairs of rows (P, 2) whose true positions are less than ``reach_m`` apart."""
    if not len(truth.stamps):
        return np.empty((0, 2), dtype=np.int64)
    rows: NDArray[np.int64] = rng.integers(0, len(truth.stamps), (50 * count, 2))
    first, second = rows.T
    near = np.hypot(*(truth.T_map_base[first, :2] - truth.T_map_base[second, :2]).T) < reach_m
    across = truth.robots[first] != truth.robots[second]
    chosen = np.flatnonzero(near & (across == across_robots) & (first != second))[:count]
    return rows[chosen]


def relative_errors(pairs: NDArray[np.int64], truth: PoseTable, estimate: PoseTable) -> RelationErrors:
    """Errors of estimated relative poses between ``pairs`` of rows (P, 2); pairs in different maps are unusable."""
    i, j = pairs[estimate.maps[pairs[:, 0]] == estimate.maps[pairs[:, 1]]].T
    true = se2.between(truth.T_map_base[i], truth.T_map_base[j])
    estimated = se2.between(estimate.T_map_base[i], estimate.T_map_base[j])
    return RelationErrors(*motion_errors(true, estimated), len(pairs))


@dataclass(frozen=True, slots=True)
class Jumps:
    """The jumps of one trajectory."""

    count: int
    largest_m: float
    """Length of the jump that exceeds the limits most, metres."""
    largest_rad: float
    """Its turn, radians."""
    within_s: float
    """Time between its two scans, seconds."""
    stamp: float
    """Stamp of the scan after it, seconds."""

    def __str__(self) -> str:
        jumps = "1 jump" if self.count == 1 else f"{self.count} jumps, the largest"
        turn_deg = np.degrees(self.largest_rad)
        size = f"{self.largest_m:.2f} m and {turn_deg:.0f} deg"
        return f"{jumps} of {size} within {self.within_s:.2f} s at {self.stamp:.3f} s"


def find_jumps(stamps: FloatArray, poses: FloatArray) -> Jumps | None:
    """The steps of a trajectory that are faster than a robot; None without any.

    ``stamps`` (N,) in seconds are of a clock that may step back; ``poses`` (N, 3), metres and radians.
    """
    if len(stamps) < 2:
        return None
    within_s = np.maximum(np.diff(stamps), 0.0)
    steps = se2.relative(poses)
    length_m, turn_rad = np.hypot(steps[:, 0], steps[:, 1]), np.abs(steps[:, 2])
    excess = np.maximum(
        length_m / (SLACK_M + LARGEST_SPEED_M_S * within_s + 1e-9),
        turn_rad / (SLACK_RAD + LARGEST_TURN_RAD_S * within_s + 1e-9),
    )
    count = int(np.count_nonzero(excess > 1.0))
    if not count:
        return None
    k = int(np.argmax(excess))
    return Jumps(count, float(length_m[k]), float(turn_rad[k]), float(within_s[k]), float(stamps[k + 1]))
