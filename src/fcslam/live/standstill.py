"""When a live robot stands still long enough for other work, such as learning."""

from collections.abc import Callable
from typing import Final

import numpy as np

from fcslam.geometry import se2
from fcslam.live.records import RobotPose
from fcslam.records import FloatArray

STANDS_AFTER_S: Final = 10.0
MOVED_M, MOVED_RAD = 0.05, 0.05
"""Largest displacement of a robot that stands; matched scans and corrections move its pose by less."""


class Standstill:
    """Follows the poses of a robot and tells when it stops and when it drives on."""

    def __init__(self, on_stop: Callable[[], None], on_drive: Callable[[], None]) -> None:
        """``on_stop`` is called once it has stood still for ten seconds of its stamps, ``on_drive`` when it moves."""
        self._on_stop, self._on_drive = on_stop, on_drive
        self._reference: FloatArray | None = None
        self._since = 0.0
        self._stands = False

    def follow(self, pose: RobotPose) -> None:
        """Take the pose of the next scan, by odometry if there is one."""
        T = pose.T_map_base if pose.T_odom_base is None else pose.T_odom_base
        moved = None if self._reference is None else se2.between(self._reference, T)
        has_moved = moved is None or np.hypot(moved[0], moved[1]) > MOVED_M or abs(moved[2]) > MOVED_RAD
        if has_moved or pose.stamp < self._since:
            self._reference, self._since = T, pose.stamp
            if self._stands:
                self._stands = False
                self._on_drive()
        elif not self._stands and pose.stamp - self._since >= STANDS_AFTER_S:
            self._stands = True
            self._on_stop()
