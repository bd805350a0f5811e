"""Makes a live robot ready for its first scan, so that no pose waits for the compiler or the garbage collector."""

import gc
from collections.abc import Iterator

import numpy as np

from fcslam.lidar.facing import contradicted_facing
from fcslam.lidar.frontend import LidarFrontend
from fcslam.lidar.lost import FEWEST_SCANS, is_lost
from fcslam.records import LaserModel, LaserScan, Sweep, frozen
from fcslam.robot.frontend import RobotConfig
from fcslam.wire.quantisation import dequantise, quantise

_LASER = LaserModel(240, -np.pi, 2.0 * np.pi / 240, 20.0)
_STEP_M, _STEPS = 0.3, 30
_ROOM, _OTHER_ROOM = (6.0, 4.5), (5.7, 4.2)
"""Half the sides of two made-up rooms, metres: similar, so that a scan of one is near surfaces of the other."""


def warm_up_tracking(config: RobotConfig) -> None:
    """Compile, or load from the cache, all code that the pose of a scan may need.

    A simulated robot crosses a room and is put down in another one, so it is lost and searches. Its laser is
    compared with the odometry. Garbage collection would take longer than a scan, so it excludes all objects that are in
    memory then.
    """
    frontend = LidarFrontend("warm-up", config.lidar)
    scans = list(_scans(_ROOM, 0.0))
    for scan in scans:
        frontend.process(scan)
    elsewhere = list(_scans(_OTHER_ROOM, scans[-1].stamp))[:FEWEST_SCANS]
    first = frontend.localize(elsewhere[0]).tracked
    is_lost(elsewhere, first.T_local_base, frontend)
    contradicted_facing(scans)
    gc.collect()
    gc.freeze()


def _scans(room: tuple[float, float], began_s: float) -> Iterator[LaserScan]:
    """Scans of a robot that drives to and fro along the middle of a room."""
    to_and_fro = np.cos(np.arange(_STEPS) * _STEP_M / room[0])
    for number, x in enumerate(0.8 * room[0] * to_and_fro):
        pose = np.array([x, 0.0, 0.1 * np.sin(0.3 * number)])
        ranges = dequantise(quantise(frozen(_ranges(room, pose), np.float32)))
        yield LaserScan(began_s + 0.1 * (number + 1), ranges, _LASER, frozen(pose), Sweep(0.0, 0.1))


def _ranges(room: tuple[float, float], pose: np.ndarray) -> np.ndarray:
    """Distances from a pose to the walls of a room around the origin, shape (beams,)."""
    angles = _LASER.angles_rad() + pose[2]
    direction = np.stack((np.cos(angles), np.sin(angles)), axis=1)
    return np.asarray(((np.sign(direction) * room - pose[:2]) / (direction + 1e-9)).min(axis=1))
