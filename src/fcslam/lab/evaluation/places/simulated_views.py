"""The images of a simulated fleet as places, and the overlap of their views.

The overlap uses the true poses and the LiDAR returns in the camera's field of view. With positions alone, two sides of
a wall would be one place.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fcslam.errors import EvaluationError
from fcslam.geometry import se2
from fcslam.lab.evaluation.fleet.ground_truth import GAP_S
from fcslam.lab.evaluation.places.view_overlap import DEPTH_AGREEMENT
from fcslam.metrics.trajectory import interpolate
from fcslam.records import CameraModel, FloatArray, LaserModel, Ranges
from fcslam.robot.views import EVERY_M, EVERY_RAD
from fcslam.runs import read_tum
from fcslam.sources.recording.frames import merged_frames, opened
from fcslam.sources.recording.layout import GROUND_TRUTH, IMAGES_FILE, META, RANGES, SCANS_FILE, image_path, read_meta


@dataclass(frozen=True, slots=True)
class FleetViews:
    """Images of all robots, robot by robot in the order of their names."""

    images: tuple[Path, ...]
    robots: NDArray[np.int64]
    """Shape (N,): the number of each image's robot."""
    overlap: FloatArray
    """Result of ``lidar_overlap``, shape (N, N), in [0, 1]."""


class _ImagePlace(NamedTuple):
    image: Path
    T_building_base: FloatArray
    ranges_m: Ranges


def read_fleet_views(folder: Path) -> FleetViews:
    """Read the images of a recorded fleet that are places.

    Raises:
        EvaluationError: there are fewer than two recordings with a camera and true poses, their sensors differ, or the
            beams of a laser vary.
        SourceError: a recording cannot be read.
    """
    robots = sorted(path.parent for path in folder.glob(f"*/{META}"))
    sensors = [(meta.lasers, meta.camera) for meta in map(read_meta, robots)]
    if len(robots) < 2 or any(pair != sensors[0] for pair in sensors):
        raise EvaluationError(f"{folder}: {len(robots)} recordings; a fleet is two or more robots with like sensors")
    (laser, *_), camera = sensors[0]
    if camera is None:
        raise EvaluationError(f"{folder}: its robots have no camera; simulate them with one")
    views = [list(_views(robot, laser)) for robot in robots]
    everything = [view for own in views for view in own]
    if not everything:
        raise EvaluationError(f"{folder}: no image at a time when it is known where the robot was")
    T_building_laser = se2.compose(np.array([view.T_building_base for view in everything]), laser.T_base_laser)
    ranges_m = np.array([view.ranges_m for view in everything], np.float64)
    overlap = lidar_overlap(T_building_laser, ranges_m, laser, half_view_rad(camera))
    numbers = np.repeat(np.arange(len(robots)), [len(own) for own in views])
    return FleetViews(tuple(view.image for view in everything), numbers, overlap)


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


def _views(robot: Path, laser: LaserModel) -> Iterator[_ImagePlace]:
    """Images with the scan before each, at least a step of distance or turn apart."""
    images, stamps, scans = [], [], []
    scan = None
    meta = read_meta(robot)
    with opened(robot / RANGES) as ranges:
        for frame in merged_frames(robot, [SCANS_FILE, IMAGES_FILE]):
            if frame.fault is not None:
                continue
            if frame.is_scan and frame.laser == 0:
                if frame.beams(meta.lasers) != laser.beams:
                    raise EvaluationError(f"{robot}: the beams of its laser vary; simulate a laser whose beams do not")
                scan = frame
            elif not frame.is_scan and scan is not None:
                images.append(image_path(robot, frame.number - 1, bytes(frame.content["suffix"]).decode()))
                stamps.append(scan.stamp)
                scans.append(scan.ranges_m(ranges))
    known, poses = read_tum(robot / GROUND_TRUTH)
    if len(known) < 2 or not images:
        return
    last = None
    for view in map(_ImagePlace, images, interpolate(known, poses, np.array(stamps), GAP_S), scans):
        if np.isnan(view.T_building_base[0]) or not view.image.is_file():
            continue
        x, y, turn = (EVERY_M, 0.0, 0.0) if last is None else se2.between(last, view.T_building_base)
        if np.hypot(x, y) >= EVERY_M or abs(turn) >= EVERY_RAD:
            last = view.T_building_base
            yield view


def half_view_rad(camera: CameraModel) -> float:
    """Angle from straight ahead to the nearer edge of the image."""
    return float(np.arctan2(min(camera.cx, camera.width - 1.0 - camera.cx) + 0.5, camera.fx))
