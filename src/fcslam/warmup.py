"""Compiles, or loads from the cache, all code that scans and packets will need, before the first one comes.

Compiling takes half a minute on a machine that has never done it, loading a second or two. Made-up robots cross a
made-up room; nothing of it reaches any mission.
"""

import gc
import os
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from typing import Final

import numpy as np

from fcslam.cloud.cloud import Cloud
from fcslam.cloud.report import keyscan_track, run_of
from fcslam.cloud.settings import FleetConfig
from fcslam.compiled import is_compiled, uncached
from fcslam.lidar import correlative, matching
from fcslam.lidar import field as field_code
from fcslam.lidar.correlative import SearchWindow, search
from fcslam.lidar.field import SurfelField, field_of
from fcslam.lidar.frontend import LidarFrontend
from fcslam.lidar.lost import FEWEST_SCANS, is_lost
from fcslam.lidar.matching import match_scan
from fcslam.lidar.occupancy import OccupancyConfig
from fcslam.lidar.scan import PointScan, point_scan
from fcslam.lidar.submap import build_submap
from fcslam.places.matcher import MatcherConfig
from fcslam.places.vocabulary import VocabularyConfig
from fcslam.processes import Background, start_copy
from fcslam.records import (
    Channel,
    CloudScan,
    FloatArray,
    Keyscan,
    KeyscanId,
    LaserModel,
    LaserScan,
    Ranges,
    Sweep,
    VoxelMap,
    frozen,
)
from fcslam.robot.backend import OwnPlaces
from fcslam.robot.frontend import RobotConfig, RobotFrontend
from fcslam.sources.logs.carmen import numbers_in
from fcslam.wire.messages import Packet
from fcslam.wire.packets import encode, measure
from fcslam.wire.quantisation import dequantise, rounded

_EMPTY_SCAN = PointScan(np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0, np.bool_), np.zeros(2))
_LASER = LaserModel(240, -np.pi, 2.0 * np.pi / 240, 20.0)
_ROOM = np.array([(1.0, 0.0, 16.0), (-1.0, 0.0, 0.0), (0.0, 1.0, 9.0), (0.0, -1.0, 0.0), (0.8, 0.6, 15.2)])
"""Walls of a made-up room without symmetry: x and y of the normal, and the distance from the origin, metres."""
_ROUND = 60
"""Made-up scans of one round through the room."""
_STEPS = 30


def warm_up_scans() -> None:
    """Compile what the first scans of a robot need: a log, points, normals, the field, matching, and the search.

    Scans without points compile the same code.
    """
    numbers_in(b"1 2", 2)
    scan = next(made_up_scans(1))
    field_of([(point_scan(scan.ranges_m, scan.laser, Sweep(0.0, 0.1)), np.zeros(3))])
    match_scan(_EMPTY_SCAN, SurfelField(np.zeros(2)), np.zeros(3), np.zeros((3, 3)))
    search(_EMPTY_SCAN, SurfelField(np.zeros(2)), np.zeros(3), SearchWindow(0.5, 0.1))
    warm_up_decoding()


def warm_up_robot() -> None:
    """Compile submaps and their description, loop closing, packets of places, the vocabulary, and its comparisons."""
    for packet in _driven("r", 2 * _ROUND):
        measure(packet)
    places = OwnPlaces(VocabularyConfig(train_batch=2, leaf_capacity=32))
    surface = build_submap([(point_scan(s.ranges_m, s.laser), s.T_odom_base) for s in made_up_scans(9)]).surface.points
    for k in range(4):
        places.store(k, surface)
        places.most_similar(k, range(k), 3)
    places.motions(0, 1)
    places.forget(0)


def warm_up_tracking(config: RobotConfig) -> None:
    """Compile all code that the pose of a scan may need: a robot drives, is put down elsewhere, and is lost.

    Garbage collection would take longer than a scan, so it leaves out all objects that are in memory then.
    """
    frontend = LidarFrontend("warm-up", config.lidar)
    scans = list(made_up_scans(_STEPS, sweep=Sweep(0.0, 0.1)))
    for scan in scans:
        frontend.process(scan)
    # In a room of nearly the same size, a scan is near surfaces of the other one.
    is_lost(list(made_up_scans(FEWEST_SCANS, 0.95, Sweep(0.0, 0.1))), frontend)
    point_scan(scans[0].ranges_m, scans[0].laser)  # of a laser that states no beam times
    gc.collect()
    gc.freeze()


def warm_up_space() -> None:
    """Compile what robots with 3D LiDARs and their fleet need beside the code of other robots."""
    from fcslam.lidar3d.voxel_matching import prepared  # robots with 2D LiDARs have no use for these
    from fcslam.robot.frontend3d import RobotFrontend3d

    robot = RobotFrontend3d("r", RobotConfig())
    for record in made_up_turns(_STEPS):
        for packet in robot.process(record):
            measure(packet)
    for packet in robot.finish():
        measure(packet)
        if isinstance(packet.body, VoxelMap):
            assert prepared(packet.body).free.any()


def warm_up_decoding() -> None:
    """Compile what the intake needs."""
    measure(Packet("r", 0, 0, 0.0, Keyscan(KeyscanId("r", 0), 0.0, dequantise(np.ones(9, np.uint16)))))


def warm_up_fleet() -> None:
    """Compile what the worker needs: decode, match, verify, solve, decide, map."""
    vocabulary = VocabularyConfig(train_batch=2, leaf_capacity=32)
    cloud = Cloud(FleetConfig(matcher=MatcherConfig(small_fleet=0, vocabulary=vocabulary)), seed=0)
    for robot in ("a", "b"):
        for packet in _driven(robot, _STEPS):
            cloud.receive(encode(packet))
    result = cloud.finalize()
    tracks = {robot.robot: keyscan_track(robot) for robot in result.robots}
    run_of(result, tracks, (), "", OccupancyConfig(), with_local_maps=False, with_certificates=False)


WARM_UPS: Final = (warm_up_scans, warm_up_robot, warm_up_fleet)
"""In the order in which a mission needs them."""


def is_cold() -> bool:
    """Whether the first scans of a robot would have to wait for the compiler."""
    return not all(map(is_compiled, (matching._match, field_code._insert, correlative._branch_and_bound)))


@contextmanager
def compiling(processes: int, runs: Sequence[Callable[[], None]] = WARM_UPS) -> Iterator[Sequence[Background]]:
    """Run the first of the warm-ups, then the others beside this block, in copies of this process.

    The copies fill the cache and end with the context. Without a cache or copies, the rest is compiled when needed.
    """
    first, *others = runs
    first()
    count = 0 if uncached() else min(processes - 1, len(others))
    copies = [start_copy(partial(_compile, others[k::count]), niceness=0) for k in range(count)]
    try:
        yield copies
    finally:
        for copy in copies:
            copy.terminate()
            copy.join()


def _compile(runs: Sequence[Callable[[], None]]) -> None:
    sys.stderr = open(os.devnull, "w")  # noqa: SIM115  who needs the code compiles it and reports why it fails
    for run in runs:
        run()


def _driven(name: str, scans: int) -> Iterator[Packet]:
    """The packets of a robot that drives around in the room."""
    robot = RobotFrontend(name, RobotConfig(channels=(Channel.LIDAR,)))
    for scan in made_up_scans(scans):
        yield from robot.process(scan)
    yield from robot.finish()


def made_up_scans(count: int, scale: float = 1.0, sweep: Sweep | None = None) -> Iterator[LaserScan]:
    """Scans of a robot that drives around in a room, ``scale`` times its size, about 0.5 m at a time."""
    turn = 2.0 * np.pi / _ROUND
    for k in range(count):
        x, y = 8.0 + 5.0 * np.cos(k * turn), 4.5 + 2.0 * np.sin(k * turn)
        heading = float(np.arctan2(2.0 * np.cos(k * turn), -5.0 * np.sin(k * turn)))
        pose = np.array((x, y, heading))
        yield LaserScan(float(k), _ranges(pose, scale), _LASER, frozen(pose), sweep)


def _ranges(pose: FloatArray, scale: float = 1.0) -> Ranges:
    angles = pose[2] + _LASER.angles_rad()
    facing = _ROOM[:, :2] @ (np.cos(angles), np.sin(angles))
    gaps_m = scale * _ROOM[:, 2:] - _ROOM[:, :2] @ pose[:2, None]
    distances_m = np.divide(gaps_m, facing, out=np.full_like(facing, np.inf), where=facing > 0.0)
    return rounded(distances_m.min(axis=0), _LASER.max_range_m)


def made_up_turns(count: int) -> Iterator[CloudScan]:
    """Turns of a 3D LiDAR at 1 m height, with wheels and an IMU, that drives through the room, 0.3 m at a time."""
    heights = np.linspace(0.0, 2.0, 9)
    for k in range(count):
        pose = np.array((3.0 + 0.3 * k, 4.0, 0.0))
        ranges, angles = _ranges(pose), _LASER.angles_rad()
        wall = np.column_stack((ranges * np.cos(angles), ranges * np.sin(angles)))
        walls = np.concatenate([np.column_stack((wall, np.full(len(wall), height))) for height in heights])
        rough = 0.002 * np.cos(np.arange(len(wall)))
        floor = np.concatenate([np.column_stack((share * wall, rough)) for share in (0.2, 0.4, 0.6, 0.8)])
        points = np.concatenate((walls, floor))
        stamps = k + np.linspace(0.0, 1.0, 11)
        wheels = np.column_stack((stamps, 3.0 + 0.3 * stamps, np.full((11, 2), (4.0, 0.0))))
        imu = np.column_stack((stamps, np.zeros((11, 5)), np.full(11, 9.81)))
        yield CloudScan(
            float(k),
            frozen(points, np.float32),
            frozen(np.zeros(len(points)), np.float32),
            frozen(np.array([0.0, 0.0, 1.0])),
            frozen(wheels),
            frozen(imu),
        )
