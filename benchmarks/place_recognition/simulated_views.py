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
from fcslam.lab.evaluation.fleet.match_views import half_view_rad, lidar_overlap
from fcslam.metrics.trajectory import interpolate
from fcslam.records import FloatArray, LaserModel, Ranges
from fcslam.robot.views import EVERY_M, EVERY_RAD
from fcslam.runs import read_tum
from fcslam.sources.recording.frames import RangesFile, merged_frames
from fcslam.sources.recording.layout import GROUND_TRUTH, IMAGES_FILE, META, SCANS_FILE, image_path, read_meta


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


def _views(robot: Path, laser: LaserModel) -> Iterator[_ImagePlace]:
    """Images with the scan before each, at least a step of distance or turn apart."""
    images, stamps, scans = [], [], []
    scan = None
    meta = read_meta(robot)
    with RangesFile(robot) as ranges:
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
