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
from fcslam.lab.evaluation.places.sets import OTHER_OVERLAP, SAME_OVERLAP
from fcslam.lab.evaluation.places.simulated_views import half_view_rad, lidar_overlap
from fcslam.metrics.closures import Rows
from fcslam.records import CameraImage, CameraModel, Channel, ClosureStatus, FloatArray, LaserModel, LaserScan, Ranges
from fcslam.runs import Run
from fcslam.sources import Recording
from fcslam.sources.recording.layout import META

STAMP_DIGITS = 9
"""Decimals of a stamp in the files of a run."""


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

    ``folder`` holds the truth; the recording of a robot is a folder of its name there.

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
