"""A made-up robot with a scanner that spins, in a room with furniture: an oracle for motion during scans."""

from functools import cache

import numpy as np

from fcslam.geometry import se2
from fcslam.metrics.trajectory import PositionErrors, align, position_errors
from fcslam.records import LaserModel, LaserScan, Sweep, frozen
from tests.lidar.worlds import box, cast

LASER = LaserModel(180, -np.pi, 2.0 * np.pi / 180, 12.0, (0.1, 0.0, 0.0))
SCAN_S = 1.0 / 7.0
SWEEP_S = SCAN_S * 179 / 180
"""From the first beam to the last."""
BEGIN_S = 100.0
"""Stamp at which the drive begins in a bag, as ROS takes 0 for no stamp."""


WALLS = np.vstack(
    (box(-4.0, -3.0, 4.5, 6.2), box(1.5, 1.2, 2.3, 1.7), box(-2.6, -2.0, -2.1, -0.9), box(2.4, -2.3, 3.4, -1.9))
)


@cache
def _way():
    dense = np.arange(0.0, 40.0, 0.002)
    turn = 0.9 * np.sin(0.8 * dense) + 0.7 * np.sin(1.9 * dense)
    heading = np.cumsum(turn) * 0.002
    x, y = np.cumsum(0.3 * np.cos(heading)) * 0.002, np.cumsum(0.3 * np.sin(heading)) * 0.002
    return dense, (x, y, heading)


def pose_at(stamps):
    """True pose in ``odom`` at ``stamps``: a winding drive that turns at up to 1.6 rad/s."""
    dense, axes = _way()
    return np.stack([np.interp(stamps, dense, axis) for axis in axes], axis=-1)


def ranges_at(stamps, rng, walls=WALLS):
    """A range for each beam, measured at its own time ``stamps`` (beam_count,)."""
    T_odom_laser = se2.compose(pose_at(stamps), LASER.T_base_laser)
    found = cast(T_odom_laser[:, :2], T_odom_laser[:, 2] + LASER.angles_rad(), walls)
    return (found + rng.normal(0.0, 0.005, len(found))).astype(np.float32)


def drive(seconds=20.0, states_sweep=True, odometry=None, begin_s=0.0, scan_s=SCAN_S, walls=WALLS):
    """Scans of the drive, with odometry ``odometry(stamp)`` at the stamp and in the sweep; None: unknown."""
    rng, sweep_s = np.random.default_rng(3), scan_s * SWEEP_S / SCAN_S
    for stamp in np.arange(begin_s, begin_s + seconds, scan_s):
        ranges = frozen(ranges_at(stamp + np.linspace(0.0, sweep_s, LASER.beam_count), rng, walls), np.float32)
        pose, sweep = np.full(3, np.nan), Sweep(0.0, sweep_s)
        if odometry is not None:
            pose = odometry(stamp)
            velocity = se2.between(pose, odometry(stamp + sweep_s)) / sweep_s
            sweep = sweep._replace(velocity=tuple(velocity.tolist()))
        yield LaserScan(float(stamp), ranges, LASER, frozen(pose), sweep if states_sweep else None)


def error_m(track):
    """Absolute trajectory error of a robot's poses: root mean square of the distances after the best alignment."""
    stamps = np.asarray(track.stamps)
    estimated, true = track.T_odom_base(), pose_at(np.where(stamps < BEGIN_S, stamps, stamps - BEGIN_S))
    return PositionErrors.of(position_errors(align(true, estimated), true, estimated)).rmse_m
