"""Do the cameras at both ends of a match see the same? The overlap of their views by true poses and LiDAR returns.

A match of images holds no motion, so the distance between the robots says little: two cameras see one wall from metres
apart. The overlap is that of ``lidar_overlap``, and it needs the robots' recordings beside the truth.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Self

import numpy as np

from fcslam.geometry import se2
from fcslam.lab.evaluation.fleet.closures import STAGES, ClosureScope, closure_rows, closure_sets
from fcslam.lab.evaluation.fleet.ground_truth import KnownPoses
from fcslam.metrics.closures import Rows
from fcslam.records import CameraImage, CameraModel, Channel, ClosureStatus, FloatArray, LaserModel, LaserScan, Ranges
from fcslam.runs import Run
from fcslam.sources import Recording
from fcslam.sources.recording.layout import META

STAMP_DIGITS = 9
"""Decimals of a stamp in the files of a run."""
SAME_OVERLAP, OTHER_OVERLAP = 0.5, 0.1
"""Views with more overlap show the same, those with less something else."""
DEPTH_AGREEMENT = 0.1
"""Largest relative difference of two depths of one surface."""


@dataclass(frozen=True, slots=True)
class MatchViews:
    """Camera matches between robots by the overlap of their views; all 0 without recordings."""

    same: int
    """More than ``SAME_OVERLAP`` of either view is in the other."""
    different: int
    """Less than ``OTHER_OVERLAP``."""
    judged: int

    @classmethod
    def of(cls, overlap: FloatArray) -> Self:
        """Count overlaps (K,); NaN is not judged."""
        counts = (overlap > SAME_OVERLAP, overlap < OTHER_OVERLAP, np.isfinite(overlap))
        return cls(*(int(np.sum(each)) for each in counts))


def judge_views(run: Run, known: KnownPoses, folder: Path) -> Mapping[ClosureStatus, MatchViews]:
    """Count the camera closures between robots by the overlap of their views, for each stage.

    Args:
        run: the run.
        known: its true poses.
        folder: folder with the truth; the recording of a robot is a folder of its name there.

    Raises:
        SourceError: a recording is there and cannot be read.
    """
    pairs, sets = closure_rows(run, known.truth), closure_sets(run)
    camera = np.array([closure.channel is Channel.CAMERA for closure in run.closures], dtype=np.bool_)
    judged = sets[ClosureScope.FLEET, ClosureStatus.CANDIDATE] & camera & np.all(pairs >= 0, axis=1)
    overlap = np.full(len(pairs), np.nan)
    overlap[judged] = _overlap(run, known, folder, pairs[judged])
    return {status: MatchViews.of(overlap[sets[ClosureScope.FLEET, status]]) for status in STAGES}


def _overlap(run: Run, known: KnownPoses, folder: Path, pairs: Rows) -> FloatArray:
    """Overlap of the views at the rows ``pairs`` (P, 2), shape (P,); NaN without recordings of like sensors."""
    rows, ends = np.unique(pairs, return_inverse=True)
    ranges_m: dict[int, Ranges] = {}
    sensors: set[tuple[LaserModel, CameraModel] | None] = set()
    for number, robot in enumerate(run.trajectories):
        mine = rows[known.truth.robots[rows] == number]
        if len(mine):
            row_of = dict(zip(known.truth.stamps[mine].round(STAMP_DIGITS).tolist(), mine.tolist(), strict=True))
            sensors.add(_read_ranges(folder / robot, row_of, ranges_m))
    if len(sensors) != 1 or (both := sensors.pop()) is None or len(ranges_m) < len(rows):
        return np.full(len(pairs), np.nan)
    laser, camera = both
    T_building_laser = se2.compose(known.truth.T_map_base[rows], laser.T_base_laser)
    ranges = np.array([ranges_m[row] for row in rows.tolist()], np.float64)
    overlap = lidar_overlap(T_building_laser, ranges, laser, half_view_rad(camera))
    found: FloatArray = overlap[tuple(ends.reshape(pairs.shape).T)]
    return found


def _read_ranges(
    path: Path, row_of: Mapping[float, int], ranges_m: dict[int, Ranges]
) -> tuple[LaserModel, CameraModel] | None:
    """Put the ranges of the scans at the stamps ``row_of`` into ``ranges_m`` by row; the sensors, None if one lacks."""
    laser, camera = None, None
    for record in Recording(path, path.name).records() if (path / META).is_file() else ():
        if isinstance(record, CameraImage):
            camera = record.camera
        elif isinstance(record, LaserScan) and (stamp := round(record.stamp, STAMP_DIGITS)) in row_of:
            laser, ranges_m[row_of[stamp]] = record.laser, record.ranges_m
    return None if laser is None or camera is None else (laser, camera)


def lidar_overlap(
    T_building_laser: FloatArray, ranges_m: FloatArray, laser: LaserModel, half_view_rad: float
) -> FloatArray:
    """Overlap of views: share of the returns of one view that the other view sees, the smaller of both directions.

    The other view sees a return if it is in its field of view and its own return in that direction has the same range,
    to a tenth. Directions without a return in the other view are ignored.

    Args:
        T_building_laser: true poses, shape (N, 3).
        ranges_m: shape (N, beams).
        laser: the laser of all scans.
        half_view_rad: half of the camera's field of view.

    Returns:
        Shape (N, N), in [0, 1].
    """
    angles = laser.angles_rad()
    ahead = np.abs(se2.wrap_angle(angles)) <= half_view_rad
    returned = np.isfinite(ranges_m) & (ranges_m > 0.0) & (ranges_m < laser.max_range_m)
    turn = max(round(2.0 * np.pi / laser.angle_increment_rad), laser.beam_count)
    padded = np.pad(
        np.where(returned, ranges_m, np.nan), ((0, 0), (0, turn - laser.beam_count)), constant_values=np.nan
    )
    shares = np.zeros((len(ranges_m), len(ranges_m)))
    for a, pose in enumerate(T_building_laser):
        beams = ahead & returned[a]
        ends = ranges_m[a, beams, None] * np.column_stack((np.cos(angles[beams]), np.sin(angles[beams])))
        there = se2.transform(se2.inverse(T_building_laser), se2.transform(pose, ends))
        bearing, distance = np.arctan2(there[..., 1], there[..., 0]), np.hypot(there[..., 0], there[..., 1])
        beam = np.rint(se2.wrap_angle(bearing - laser.angle_min_rad) / laser.angle_increment_rad).astype(int) % turn
        met = np.take_along_axis(padded, beam, axis=1)
        in_view = np.abs(bearing) <= half_view_rad
        again = in_view & (np.abs(met - distance) <= DEPTH_AGREEMENT * distance)
        judged = ~in_view | np.isfinite(met)
        shares[a] = again.sum(axis=1) / np.maximum(judged.sum(axis=1), 1)
    return np.minimum(shares, shares.T)


def half_view_rad(camera: CameraModel) -> float:
    """Angle from straight ahead to the nearer edge of the image."""
    return float(np.arctan2(min(camera.cx, camera.width - 1.0 - camera.cx) + 0.5, camera.fx))
