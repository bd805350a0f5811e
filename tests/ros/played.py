"""Scans as the players read them."""

import numpy as np


def for_player(path, scans):
    """Write a robot's scans for ``rclpy_player.py``."""
    laser, sweep = scans[0].laser, scans[0].sweep
    np.savez(
        path,
        stamps=[scan.stamp for scan in scans],
        ranges=[scan.ranges_m for scan in scans],
        odometry=[scan.T_odom_base for scan in scans],
        laser=[laser.angle_min_rad, laser.angle_increment_rad, laser.max_range_m],
        beam_s=0.0 if sweep is None else sweep.duration_s / (laser.beam_count - 1),
    )
