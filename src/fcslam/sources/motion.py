"""The motion of a robot during a scan, from the odometry around it."""

from bisect import bisect_left, bisect_right
from collections.abc import Sequence
from math import hypot
from operator import attrgetter
from typing import Final

import numpy as np

from fcslam.geometry import se2
from fcslam.records import Odometry, Sweep
from fcslam.sources.bags.messages import OdometryReading
from fcslam.sources.pose import Pose, relative_pose

_stamp_of = attrgetter("stamp")

SAMPLES: Final = 9
"""Poses by odometry that the motion during a sweep is fitted to."""
LARGEST_SPEED: Final = 10.0
"""Largest speed of a robot that maps a building, m/s and rad/s; odometry that starts at zero again shows more."""
LARGEST_ACCELERATION: Final = 50.0
"""Largest acceleration of a robot, m/s^2 and rad/s^2; odometry that jumps shows more."""


ROUNDING: Final = 1e-9
"""A reading that differs by less, in metres and radians, repeats the previous one."""
FEWEST_STEPS: Final = 4
"""Steps of a moving robot that show it."""
LONGEST_UPDATE_S: Final = 0.35
"""A robot whose odometry does not change for longer stands still."""
STILL_M, STILL_RAD = 0.005, 0.003
"""Odometry that moved less stands still."""


Reading = Odometry | OdometryReading


class OdometryUpdates:
    """Finds readings that repeat an older pose, of odometry that is published more often than it is updated.

    Such odometry stays and jumps while the robot moves. It says where the robot was when it changed; between two
    changes, the pose is interpolated. Readings of a robot at rest repeat as well, but for longer.
    """

    def __init__(self) -> None:
        self._longest_s = 0.0
        """Longest time between two updates of a moving robot with repeats between them."""
        self._moves = self._steps = 0
        """Updates of a moving robot, and those after repeats."""
        self._update: tuple[float, Pose] | None = None
        """Stamp and pose of the newest reading that differs from the previous one."""
        self._repeats = 0

    @property
    def period_s(self) -> float:
        """Longest time between two updates of a moving robot; 0 if every reading is an update."""
        is_rare = self._steps >= FEWEST_STEPS and 2 * self._steps > self._moves
        return self._longest_s if is_rare else 0.0

    def is_fresh(self, stamp: float, T_odom_base: Pose) -> bool:
        """Whether the next reading says where the robot is at its stamp."""
        if self._update is not None:
            changed_s, pose = self._update
            held_s = stamp - changed_s
            x, y, theta = relative_pose(pose, T_odom_base)
            if max(abs(x), abs(y), abs(theta)) < ROUNDING:
                self._repeats += 1
                return not 0.0 <= held_s <= self.period_s
            if hypot(x, y) > STILL_M or abs(theta) > STILL_RAD:
                self._moves += 1
                if self._repeats and 0.0 < held_s <= LONGEST_UPDATE_S:
                    self._steps += 1
                    self._longest_s = max(self._longest_s, held_s)
        self._update, self._repeats = (stamp, T_odom_base), 0
        return True


def moving_sweep(sweep: Sweep, stamp: float, readings: Sequence[Reading]) -> Sweep:
    """The sweep with the motion by odometry: the least-squares fit of a constant acceleration, or none if it jumps.

    ``readings`` are those up to the scan and beyond it, in the order of their stamps.
    """
    first_s, last_s = stamp + min(0.0, sweep.first_s, sweep.last_s), stamp + max(0.0, sweep.first_s, sweep.last_s)
    end = bisect_left(readings, last_s, key=_stamp_of)
    begin = min(bisect_right(readings, first_s, key=_stamp_of), end, len(readings) - 1) - 1
    near = readings[max(0, begin) : end + 1]
    if len(near) < 2:
        return sweep
    stamps, poses = np.array([reading.stamp for reading in near]), np.array([reading.T_odom_base for reading in near])
    poses[:, 2] = np.unwrap(poses[:, 2])
    # Odometry that ends within the sweep says nothing about the rest of it: the fit goes on.
    begin_s = max(min(sweep.first_s, sweep.last_s), stamps[0] - stamp)
    end_s = min(max(sweep.first_s, sweep.last_s), stamps[-1] - stamp)
    if end_s - begin_s < 0.5 * sweep.duration_s:
        begin_s, end_s = stamps[0] - stamp, stamps[-1] - stamp
    times = np.linspace(begin_s, end_s, SAMPLES)
    at = np.stack([np.interp(stamp + np.append(0.0, times), stamps, axis) for axis in poses.T], axis=1)
    motion = se2.between(at[0], at[1:])
    design = np.stack((times, 0.5 * times**2), axis=1)
    (velocity, acceleration), *_ = np.linalg.lstsq(design, motion, rcond=None)
    if np.abs(acceleration).max() > LARGEST_ACCELERATION:
        velocity, acceleration = np.linalg.lstsq(design[:, :1], motion, rcond=None)[0][0], np.zeros(3)
    if np.abs(velocity).max() > LARGEST_SPEED:
        return sweep
    (vx, vy, vtheta), (ax, ay, atheta) = velocity.tolist(), acceleration.tolist()
    return sweep._replace(velocity=(vx, vy, vtheta), acceleration=(ax, ay, atheta))
