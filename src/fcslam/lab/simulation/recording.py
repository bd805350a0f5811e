"""Writes the recordings of a simulated fleet, and its ground truth: the true poses and the true map."""

from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Final

import numpy as np

import fcslam
from fcslam.config import dump
from fcslam.errors import InputError, writing
from fcslam.geometry import se2
from fcslam.lab.simulation.drivable_space import CELL_M
from fcslam.lab.simulation.simulated_fleet import SimulatedFleet, SimulatedRobot, SimulationSettings
from fcslam.maps.occupancy_map import Cells, Occupancy, OccupancyMap, map_yaml, pgm_bytes
from fcslam.records import FloatArray, LaserModel, LaserScan, SensorRecord, frozen
from fcslam.runs import write_tum
from fcslam.sources import write_bag
from fcslam.storage.files import write_file

SETTINGS: Final = "simulation.yaml"
"""File with the settings of the fleet in a folder, which determine all its recordings."""

GROUND_TRUTH: Final = "ground_truth.tum"

Watch = Callable[[Iterator[SensorRecord]], Iterator[SensorRecord]]

RESOLUTION_M = CELL_M

_MARGIN = 2
"""Unknown cells around the building."""
_FRACTION_BITS = 8
"""Fractional bits of OpenCV's fixed-point coordinates, when beams are drawn."""


def prepare_fleet_folder(folder: Path, settings: SimulationSettings, seed: int) -> None:
    """Make the fleet's folder and write its settings."""
    text = f"# What fcslam simulated here.\nfcslam: {fcslam.__version__}\nseed: {seed}\n{dump(settings)}"
    with writing(folder, "choose another output folder"):
        folder.mkdir(parents=True, exist_ok=True)
        if any(folder.iterdir()):
            raise InputError(f"{folder}: is not empty; choose another place")
        write_file(folder / SETTINGS, text)


def record_robot(robot: SimulatedRobot, folder: Path, watch: Watch = iter) -> None:
    """Write the robot's recording to ``folder``, a bag of ROS 2, and its true poses to ``GROUND_TRUTH`` in it.

    ``watch`` receives the records and passes them on; the recording ends when it ends.
    """
    with closing(robot.records()) as records:
        write_bag(folder, watch(map(_as_driver, records)))
    with writing(folder, "choose another output folder"):
        write_tum(folder / GROUND_TRUTH, *robot.truth)


def _as_driver(record: SensorRecord) -> SensorRecord:
    """A scan as drivers of ROS send it: a beam without a return is inf."""
    if not isinstance(record, LaserScan):
        return record
    is_far = record.ranges_m >= record.laser.max_range_m
    return replace(record, ranges_m=frozen(np.where(is_far, np.inf, record.ranges_m), np.float32))


def write_ground_truth(fleet: SimulatedFleet, folder: Path) -> None:
    """Write the true map into ``folder``, ``ground_truth/map.pgm`` and ``map.yaml``; recordings have true poses."""
    place = folder / "ground_truth"
    place.mkdir(parents=True, exist_ok=True)
    seen = true_map(fleet)
    write_file(place / "map.pgm", pgm_bytes(seen))
    write_file(place / "map.yaml", map_yaml(seen, "map.pgm"))


def true_map(fleet: SimulatedFleet) -> OccupancyMap:
    """The map of the robots' beams without noise, from their true poses: surfaces, and free space before them.

    The coordinate frame is the building's. A beam that returns nothing leaves its cells unknown. Where furniture moved,
    every surface that a robot saw is occupied.
    """
    width, height = (int(np.ceil(size / RESOLUTION_M)) + 2 * _MARGIN for size in fleet.plan.size_m)
    passed, hit = (np.zeros((height, width), dtype=np.uint8) for _ in range(2))
    for robot in fleet.robots:
        _draw_beams(robot, passed, hit)
    cells = np.full((height, width), Occupancy.UNKNOWN, dtype=np.uint8)
    cells[passed > 0] = Occupancy.FREE
    cells[hit > 0] = Occupancy.OCCUPIED
    return OccupancyMap(cells, RESOLUTION_M, (-_MARGIN * RESOLUTION_M,) * 2)


def _draw_beams(robot: SimulatedRobot, passed: Cells, hit: Cells) -> None:
    import cv2

    caster = robot.world.caster(robot.plan)
    for pose, laser in product(_spaced(robot.T_building_base), robot.lasers):
        start, ends = _beams(caster.cast(pose, laser), laser, pose)
        columns, rows = np.floor(ends).astype(int).T
        hit[rows, columns] = 1
        # OpenCV counts from the middle of the first cell.
        lines = np.stack((np.broadcast_to(start, ends.shape), ends), axis=1) - 0.5
        drawn = np.round(lines * 2**_FRACTION_BITS).astype(np.int32)
        cv2.polylines(passed, list(drawn), False, 1, shift=_FRACTION_BITS)


def _spaced(poses: FloatArray) -> FloatArray:
    """Select poses (N, 3) with 0.2 m or 0.2 rad between them; closer scans add almost nothing to the map."""
    x, y, turn = se2.relative(poses).T
    steps = np.insert(np.cumsum(np.hypot(x, y) / 0.2 + np.abs(turn) / 0.2), 0, 0.0)
    return poses[np.unique(np.floor(steps), return_index=True)[1]]


def _beams(ranges_m: FloatArray, laser: LaserModel, T_building_base: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Start (2,) and ends (N, 2) of the beams that hit a surface, in cells."""
    x, y, heading = se2.compose(T_building_base, np.array(laser.T_base_laser))
    returned = ranges_m < laser.max_range_m
    angles = heading + laser.angles_rad()[returned]
    start = np.array([x, y])
    # A millimetre longer, so that the end falls into the cell of the wall, not of the free space before it.
    ends = start + (ranges_m[returned] + 1e-3)[:, None] * np.column_stack((np.cos(angles), np.sin(angles)))
    return start / RESOLUTION_M + _MARGIN, ends / RESOLUTION_M + _MARGIN
