"""The images of a simulated fleet as places, and as ends of matches: the overlap of their views.

The overlap uses the true poses and the LiDAR returns in the camera's field of view. With positions alone, two sides of
a wall would be one place.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from fcslam.errors import InputError
from fcslam.geometry import se2
from fcslam.lab.evaluation.closures import STAGES, ClosureScope, closure_rows, closure_sets
from fcslam.lab.evaluation.ground_truth import GAP_S, known_poses
from fcslam.metrics.closures import Rows
from fcslam.metrics.relations import PoseTable
from fcslam.metrics.trajectory import interpolate
from fcslam.records import CameraImage, CameraModel, Channel, ClosureStatus, FloatArray, LaserModel, LaserScan, Ranges
from fcslam.robot.views import EVERY_M, EVERY_RAD
from fcslam.runs import Run, open_run, read_tum
from fcslam.sources import open_source

from .view_overlap import DEPTH_AGREEMENT, OTHER_OVERLAP, SAME_OVERLAP

GROUND_TRUTH: Final = "ground_truth.tum"
IMAGES: Final = "places"
"""Folder in that of the fleet, to which the images of its places are written."""


@dataclass(frozen=True, slots=True)
class FleetViews:
    """Images of all robots, robot by robot in the order of their names."""

    images: tuple[Path, ...]
    robots: NDArray[np.int64]
    """Shape (N,): the number of each image's robot."""
    overlap: FloatArray
    """Result of ``lidar_overlap``, shape (N, N), in [0, 1]."""


class _View(NamedTuple):
    image: CameraImage
    number: int
    """Counts the robot's images from 0."""
    scan: LaserScan
    """The scan before the image."""
    T_building_base: FloatArray
    """True pose at the scan."""


def read_fleet_views(folder: Path) -> FleetViews:
    """Read the images of a recorded fleet that are places, and write them to ``IMAGES`` in its folder.

    Raises:
        InputError: there are fewer than two recordings with a camera and true poses, or their sensors differ.
        SourceError: a recording cannot be read.
    """
    robots = sorted(path.parent for path in folder.glob(f"*/{GROUND_TRUTH}"))
    views = [list(_views(robot)) for robot in robots]
    sensors = {(view.scan.laser, view.image.camera) for own in views for view in own}
    if len(robots) < 2 or len(sensors) > 1:
        raise InputError(f"{folder}: {len(robots)} recordings; a fleet is two or more robots with like sensors")
    if not all(views):
        raise InputError(f"{folder}: a robot has no image whose pose is known; simulate it with a camera")
    ((laser, camera),) = sensors
    everything = [view for own in views for view in own]
    T_building_laser = se2.compose(np.array([view.T_building_base for view in everything]), laser.T_base_laser)
    ranges_m = np.array([view.scan.ranges_m for view in everything], np.float64)
    overlap = lidar_overlap(T_building_laser, ranges_m, laser, half_view_rad(camera))
    images = [
        _written(folder / IMAGES / robot.name, view) for robot, own in zip(robots, views, strict=True) for view in own
    ]
    numbers = np.repeat(np.arange(len(robots)), [len(own) for own in views])
    return FleetViews(tuple(images), numbers, overlap)


def lidar_overlap(
    T_building_laser: FloatArray, ranges_m: FloatArray, laser: LaserModel, half_view_rad: float
) -> FloatArray:
    """Share of the returns of a view that another one sees, the smaller of both directions, shape (N, N), in [0, 1].

    The other view sees a return if it is in its field of view, ``half_view_rad`` to each side, and its own return in
    that direction has the same range, to a tenth. Directions without a return in the other view are ignored. The true
    poses have shape (N, 3), the ranges (N, beams).
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


def _views(robot: Path) -> Iterator[_View]:
    """Images with the scan before each, at least a step of distance or turn apart."""
    found: list[tuple[CameraImage, int, LaserScan]] = []
    scan, number = None, 0
    for record in open_source(robot).records():
        if isinstance(record, LaserScan):
            scan = record
        elif isinstance(record, CameraImage):
            if scan is not None:
                found.append((record, number, scan))
            number += 1
    known, poses = read_tum(robot / GROUND_TRUTH)
    if len(known) < 2 or not found:
        return
    at_scans = interpolate(known, poses, np.array([scan.stamp for *_, scan in found]), GAP_S)
    last = None
    for view in (_View(*each, pose) for each, pose in zip(found, at_scans, strict=True)):
        if np.isnan(view.T_building_base[0]):
            continue
        x, y, turn = (EVERY_M, 0.0, 0.0) if last is None else se2.between(last, view.T_building_base)
        if np.hypot(x, y) >= EVERY_M or abs(turn) >= EVERY_RAD:
            last = view.T_building_base
            yield view


def _written(folder: Path, view: _View) -> Path:
    suffix = ".png" if view.image.encoded.startswith(b"\x89PNG") else ".jpg"
    path = folder / f"{view.number:06d}{suffix}"
    folder.mkdir(parents=True, exist_ok=True)
    path.write_bytes(view.image.encoded)
    return path


def half_view_rad(camera: CameraModel) -> float:
    """Angle from straight ahead to the nearer edge of the image."""
    return float(np.arctan2(min(camera.cx, camera.width - 1.0 - camera.cx) + 0.5, camera.fx))


STAMP_DIGITS = 9
"""Decimals of a stamp in the files of a run."""


@dataclass(frozen=True, slots=True)
class MatchViews:
    """Camera matches between robots by the overlap of their views."""

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


def judge_views(path: Path, folder: Path) -> Mapping[ClosureStatus, MatchViews]:
    """Count the camera closures between robots of a run folder by the overlap of their views, for each stage.

    ``folder`` holds the truth, and the recording of each robot in a folder of its name.

    Raises:
        SourceError: a recording cannot be read.
    """
    run = open_run(path)
    _, true = known_poses(run, folder)
    pairs, sets = closure_rows(run, true), closure_sets(run)
    camera = np.array([closure.channel is Channel.CAMERA for closure in run.closures], dtype=np.bool_)
    judged = sets[ClosureScope.FLEET, ClosureStatus.CANDIDATE] & camera & np.all(pairs >= 0, axis=1)
    overlap = np.full(len(pairs), np.nan)
    overlap[judged] = _overlap(run, true, folder, pairs[judged])
    return {status: MatchViews.of(overlap[sets[ClosureScope.FLEET, status]]) for status in STAGES}


def _overlap(run: Run, true: PoseTable, folder: Path, pairs: Rows) -> FloatArray:
    """Overlap of the views at the rows ``pairs`` (P, 2), shape (P,); NaN without recordings of like sensors."""
    rows, ends = np.unique(pairs, return_inverse=True)
    ranges_m: dict[int, Ranges] = {}
    sensors: set[tuple[LaserModel, CameraModel] | None] = set()
    for number, robot in enumerate(run.trajectories):
        mine = rows[true.robots[rows] == number]
        if len(mine):
            row_of = dict(zip(true.stamps[mine].round(STAMP_DIGITS).tolist(), mine.tolist(), strict=True))
            sensors.add(_read_ranges(folder / robot, row_of, ranges_m))
    if len(sensors) != 1 or (both := sensors.pop()) is None or len(ranges_m) < len(rows):
        return np.full(len(pairs), np.nan)
    laser, camera = both
    T_building_laser = se2.compose(true.T_map_base[rows], laser.T_base_laser)
    ranges = np.array([ranges_m[row] for row in rows.tolist()], np.float64)
    overlap = lidar_overlap(T_building_laser, ranges, laser, half_view_rad(camera))
    found: FloatArray = overlap[tuple(ends.reshape(pairs.shape).T)]
    return found


def _read_ranges(
    path: Path, row_of: Mapping[float, int], ranges_m: dict[int, Ranges]
) -> tuple[LaserModel, CameraModel] | None:
    """Put the ranges of the scans at the stamps ``row_of`` into ``ranges_m`` by row; the sensors, None if one lacks."""
    laser, camera = None, None
    for record in open_source(path).records():
        if isinstance(record, CameraImage):
            camera = record.camera
        elif isinstance(record, LaserScan) and (stamp := round(record.stamp, STAMP_DIGITS)) in row_of:
            laser, ranges_m[row_of[stamp]] = record.laser, record.ranges_m
    return None if laser is None or camera is None else (laser, camera)
