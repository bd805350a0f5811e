"""Makes a live robot ready for its first scan, so that no pose waits for the compiler or the garbage collector."""

import gc
from collections.abc import Iterator

import numpy as np

from fcslam.lidar.frontend import LidarFrontend
from fcslam.lidar.lost import FEWEST_SCANS, is_lost
from fcslam.lidar.scan import point_scan
from fcslam.records import FloatArray, LaserModel, LaserScan, Ranges, Sweep, frozen
from fcslam.robot.frontend import RobotConfig
from fcslam.wire.quantisation import rounded

MADE_UP_LASER = LaserModel(240, -np.pi, 2.0 * np.pi / 240, 20.0)
_WALLS = np.array(
    [
        (0.0, 0.0, 16.0, 0.0),
        (16.0, 0.0, 16.0, 9.0),
        (16.0, 9.0, 0.0, 9.0),
        (0.0, 9.0, 0.0, 0.0),
        (4.0, 0.0, 4.0, 1.5),
        (7.0, 9.0, 8.5, 7.0),
        (12.0, 0.0, 12.5, 2.0),
        (13.0, 6.5, 16.0, 6.0),
    ]
)
"""x, y of both ends, metres, in a made-up room."""
_OTHER_WALLS = 0.95 * _WALLS
"""In a similar room: a scan of one is near surfaces of the other."""
ROUND = 60
"""Made-up scans of one round through the room."""
_STEPS = 30


def warm_up_tracking(config: RobotConfig) -> None:
    """Compile, or load from the cache, all code that the pose of a scan may need.

    A made-up robot drives around in a room and is put down in another one, so it is lost and searches. Garbage
    collection would take longer than a scan, so it excludes all objects that are in memory then.
    """
    frontend = LidarFrontend("warm-up", config.lidar)
    scans = list(made_up_scans(_STEPS, sweep=Sweep(0.0, 0.1)))
    for scan in scans:
        frontend.process(scan)
    elsewhere = list(made_up_scans(FEWEST_SCANS, _OTHER_WALLS, Sweep(0.0, 0.1)))
    is_lost(elsewhere, frontend)
    point_scan(scans[0].ranges_m, scans[0].laser)  # of a laser that states no beam times
    gc.collect()
    gc.freeze()


def made_up_scans(count: int, walls: FloatArray = _WALLS, sweep: Sweep | None = None) -> Iterator[LaserScan]:
    """Scans of a robot that drives around in a room with ``walls``, shape (W, 4), about 0.5 m at a time."""
    turn = 2.0 * np.pi / ROUND
    for k in range(count):
        x, y = 8.0 + 5.0 * np.cos(k * turn), 4.5 + 2.0 * np.sin(k * turn)
        heading = float(np.arctan2(2.0 * np.cos(k * turn), -5.0 * np.sin(k * turn)))
        pose = np.array((x, y, heading))
        yield LaserScan(float(k), made_up_ranges(pose, walls), MADE_UP_LASER, frozen(pose), sweep)


def made_up_ranges(pose: FloatArray, walls: FloatArray = _WALLS) -> Ranges:
    """Distance to the nearest wall along every beam, as it is sent, shape (B,)."""
    angles = pose[2] + MADE_UP_LASER.angles_rad()
    beams = np.stack((np.cos(angles), np.sin(angles)), axis=-1)[:, np.newaxis]
    starts, along = walls[:, :2] - pose[:2], walls[:, 2:] - walls[:, :2]
    with np.errstate(divide="ignore", invalid="ignore"):
        facing = _cross(beams, along)
        distance, share = _cross(starts, along) / facing, _cross(starts, beams) / facing
    hit = (distance > 0.0) & (share >= 0.0) & (share <= 1.0)
    return rounded(np.where(hit, distance, np.inf).min(axis=1), MADE_UP_LASER.max_range_m)


def _cross(a: FloatArray, b: FloatArray) -> FloatArray:
    return np.asarray(a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0])
