"""Estimated trajectories of a fleet against the truth: absolute errors after alignment, errors of relative poses.

The truth is in one coordinate frame, ``truth``, the estimate in one ``map`` for each map. ATE (absolute trajectory
error) is what remains after *one* rigid motion has put a whole map onto the truth, so robots that lie wrongly to each
other show; J. Sturm et al., "A Benchmark for the Evaluation of RGB-D SLAM Systems", IROS 2012, without scale. An
alignment has no reflection: a mirrored map stays wrong.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fcslam.geometry import se2
from fcslam.geometry.alignment import n_point_alignment
from fcslam.metrics.relations import PoseTable, RelationErrors, motion_errors
from fcslam.records import SAME_STAMP_S, FloatArray

_DRAWS_PER_PAIR = 50


@dataclass(frozen=True, slots=True)
class PositionErrors:
    """How far positions lie from the true ones, metres; all NaN for none."""

    rmse_m: float
    mean_m: float
    max_m: float

    @classmethod
    def of(cls, errors_m: FloatArray) -> "PositionErrors":
        """Of the distances ``errors_m``, shape (N,)."""
        if not len(errors_m):
            return cls(np.nan, np.nan, np.nan)
        return cls(float(np.sqrt(np.mean(errors_m**2))), float(np.mean(errors_m)), float(np.max(errors_m)))


def interpolate(stamps: FloatArray, T: FloatArray, wanted: FloatArray, gap_s: float) -> FloatArray:
    """Poses at the stamps ``wanted`` (K,) from poses ``T`` (N, 3) at ``stamps`` (N,), which may be in any order.

    Positions and headings go straight from one pose to the next. NaN at a stamp that lies between poses more than
    ``gap_s`` apart, and at one before the first or after the last.
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
    """``T_truth_map`` (3,) with the least squared distances of positions, from poses (N, 3) at the same stamps.

    NaN if the robots did not move: then positions determine no rotation.
    """
    return n_point_alignment(T_truth_base[:, :2], T_map_base[:, :2])


def position_errors(T_truth_map: FloatArray, T_truth_base: FloatArray, T_map_base: FloatArray) -> FloatArray:
    """Distances (N,) between true positions and estimated ones moved into the truth's frame."""
    moved = se2.transform(T_truth_map, T_map_base[:, :2])
    distances: FloatArray = np.linalg.norm(moved - T_truth_base[:, :2], axis=-1)
    return distances


@dataclass(frozen=True, slots=True)
class TrajectoryPair:
    """Poses of one robot at the same stamps: where it was and where its map says that it was."""

    T_truth_base: FloatArray
    """Shape (N, 3)."""
    T_map_base: FloatArray
    """Shape (N, 3)."""

    def alignment(self) -> FloatArray:
        """``T_truth_map`` by positions and headings, so that a robot that stands still has one too."""
        both = (self.T_truth_base, self.T_map_base)
        truth, estimate = (np.concatenate((T[:, :2], se2.compose(T, (1.0, 0.0, 0.0))[:, :2])) for T in both)
        return n_point_alignment(truth, estimate)


def placement_error(a: TrajectoryPair, b: TrajectoryPair) -> tuple[float, float]:
    """How wrongly two robots of one map lie to each other: metres and degrees.

    Each robot by itself says where the map lies in the truth. If the robots lie rightly to each other, both say the
    same; else the difference is what one would have to be moved, measured in the middle of both.
    """
    off = se2.between(a.alignment(), b.alignment())
    middle = np.concatenate((a.T_map_base, b.T_map_base))[:, :2].mean(axis=0)
    shift = se2.transform(off, middle[None])[0] - middle
    return float(np.hypot(*shift)), float(np.degrees(np.abs(off[2])))


def near_pairs(
    truth: PoseTable, rng: np.random.Generator, across_robots: bool, count: int = 2000, reach_m: float = 5.0
) -> NDArray[np.int64]:
    """Up to ``count`` pairs of rows (P, 2), drawn evenly from those that truth puts less than ``reach_m`` apart.

    Pairs of different robots, or of one robot.
    """
    if not len(truth.stamps):
        return np.empty((0, 2), dtype=np.int64)
    rows: NDArray[np.int64] = rng.integers(0, len(truth.stamps), (_DRAWS_PER_PAIR * count, 2))
    first, second = rows.T
    near = np.hypot(*(truth.T_map_base[first, :2] - truth.T_map_base[second, :2]).T) < reach_m
    across = truth.robots[first] != truth.robots[second]
    chosen = np.flatnonzero(near & (across == across_robots) & (first != second))[:count]
    return rows[chosen]


def relative_errors(pairs: NDArray[np.int64], truth: PoseTable, estimate: PoseTable) -> RelationErrors:
    """Errors of the estimated motions between ``pairs`` of rows (P, 2); pairs in different maps are not usable."""
    i, j = pairs[estimate.maps[pairs[:, 0]] == estimate.maps[pairs[:, 1]]].T
    true = se2.between(truth.T_map_base[i], truth.T_map_base[j])
    estimated = se2.between(estimate.T_map_base[i], estimate.T_map_base[j])
    return RelationErrors(*motion_errors(true, estimated), len(pairs))
