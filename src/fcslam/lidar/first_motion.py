"""How a robot without odometry moved during its first scan.

The points of a scanner that spins are placed by the velocity of the robot. A later scan begins with that of the scan
before. The first one has the second one: the motion between both stamps is the mean motion of the first sweep. Both are
placed by this motion and matched again, until it stays the same.
"""

import math
from dataclasses import replace
from typing import Final

import numpy as np

from fcslam.geometry import se2
from fcslam.lidar.odometry import OdometryModel
from fcslam.lidar.tracker import ScanTracker
from fcslam.records import LaserScan, Sweep, frozen
from fcslam.sources.motion import STILL_M, STILL_RAD

LONGEST_GAP_S: Final = 1.0
"""A scan after a longer gap says nothing about the motion during the previous one, nor the reverse."""
PASSES: Final = 8
"""Most matches of the two scans."""
SIGMAS: Final = 3.0
"""A motion that the points show less clearly, in standard deviations, may be none."""


def first_sweep(first: LaserScan, second: LaserScan, odometry: OdometryModel) -> Sweep | None:
    """The sweep of the first scan of a robot, with the velocity that the second one shows.

    It has no velocity if the scans show no motion; it is that of ``first`` if they cannot be compared.
    """
    elapsed_s = second.stamp - first.stamp
    is_one_laser = first.laser.T_base_laser == second.laser.T_base_laser
    if first.sweep is None or second.sweep is None or not is_one_laser or not 0.0 < elapsed_s <= LONGEST_GAP_S:
        return first.sweep
    sweep, T_first_second = Sweep(first.sweep.first_s, first.sweep.last_s), np.zeros(3)
    for _ in range(PASSES):
        tracker = ScanTracker(odometry)
        begun = tracker.localize(replace(first, T_odom_base=frozen(np.zeros(3)), sweep=sweep))
        assert begun.tracked.scan is not None  # a scan without earlier ones is not matched
        tracker.commit(begun)
        tracker.insert(begun.tracked.scan, begun.tracked.T_local_base)
        guess = second.sweep._replace(velocity=sweep.velocity)
        found = tracker.localize(replace(second, T_odom_base=frozen(T_first_second), sweep=guess)).tracked
        before, T_first_second = T_first_second, found.T_local_base
        if T_first_second @ found.information @ T_first_second < SIGMAS**2:
            return Sweep(first.sweep.first_s, first.sweep.last_s)
        x, y, theta = (se2.log(T_first_second) / elapsed_s).tolist()
        sweep = sweep._replace(velocity=(x, y, theta))
        dx, dy, turn = se2.motion(before, T_first_second)
        if math.hypot(dx, dy) < STILL_M and abs(turn) < STILL_RAD:
            break
    return sweep
