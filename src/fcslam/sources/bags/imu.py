"""The readings of an IMU in a bag or of a live robot: sensor_msgs/Imu."""

from collections import deque
from collections.abc import Iterable
from typing import Any, Final, NamedTuple

import numpy as np

from fcslam.records import FloatArray, Transform, frozen
from fcslam.sources.bags.codec import IMU
from fcslam.sources.bags.container import Topic
from fcslam.sources.bags.messages import header_of
from fcslam.sources.bags.robots import BagRobot
from fcslam.sources.bags.transforms import NoTransformError, TransformTree

_LARGEST_RATE: Final = 35.0
"""A gyro that measures more, rad/s, is broken."""
_AFTER_S: Final = 0.02
"""Readings of a gyro so long after a scan show its end."""


class ImuReading(NamedTuple):
    """A reading in the axes of its sensor."""

    stamp: float
    frame: str
    values: tuple[float, ...]
    """Angular velocity in rad/s, and specific force in m/s^2."""


def imu_topics(robot: BagRobot) -> list[Topic]:
    """The topics of IMUs of a robot, the one with most messages first."""
    topics = [topic for topic in robot.topics if topic.type == IMU and topic.message_count]
    return sorted(topics, key=lambda topic: (-topic.message_count, topic.name))


def imu_of(content: Any, bag_time_ns: int) -> ImuReading:
    """Convert a message; raises ValueError if it is invalid or has no angular velocity."""
    stamp, frame = header_of(content.header, bag_time_ns)
    if content.angular_velocity_covariance[0] == -1.0:
        raise ValueError("the IMU measures no angular velocity")
    rate, force = content.angular_velocity, content.linear_acceleration
    values = (rate.x, rate.y, rate.z, force.x, force.y, force.z)
    if not (np.isfinite(values).all() and max(map(abs, values[:3])) < _LARGEST_RATE):
        raise ValueError("the angular velocity or the acceleration cannot be that of a robot")
    return ImuReading(stamp, frame, values)


class ImuAxes:
    """Turns readings into the axes of the base, as tf has them; a frame that tf lacks is taken as parallel."""

    def __init__(self, tree: TransformTree, base_frame: str) -> None:
        self._tree, self._base_frame = tree, base_frame
        self._rotations: dict[str, FloatArray] = {}

    def row(self, reading: ImuReading, ahead_s: float = 0.0) -> list[float]:
        """Stamp, angular velocity and specific force in the axes of the base, of a sensor whose clock is ``ahead_s``
        ahead.
        """
        if reading.frame not in self._rotations:
            try:
                turn: Transform = self._tree.fixed(self._base_frame, reading.frame)
                self._rotations[reading.frame] = turn.rotation_matrix()
            except NoTransformError:
                self._rotations[reading.frame] = np.eye(3)
        rotation = self._rotations[reading.frame]
        return [reading.stamp - ahead_s, *rotation @ reading.values[:3], *rotation @ reading.values[3:]]

    def turn(self, reading: ImuReading, ahead_s: float) -> tuple[float, float]:
        """Stamp and angular velocity about the vertical, of a sensor whose clock is ``ahead_s`` ahead."""
        stamp, _, _, rate_rad_s, *_ = self.row(reading, ahead_s)
        return stamp, rate_rad_s


class GyroReadings:
    """The readings of a gyro that no scan of its robot, which has no odometry, was given yet."""

    def __init__(self, turns: Iterable[tuple[float, float]] = ()) -> None:
        """``turns`` are the readings that are known: stamps, and angular velocities about the vertical."""
        self._turns = deque(turns)
        self._is_there = bool(self._turns)

    def add(self, stamp: float, rate_rad_s: float) -> None:
        """Add the next reading."""
        self._turns.append((stamp, rate_rad_s))
        self._is_there = True

    def take(self, end_s: float) -> FloatArray | None:
        """The readings for a scan that ends at ``end_s``, shape (K, 2); None if there is no gyro."""
        taken: list[tuple[float, float]] = []
        while self._turns and self._turns[0][0] <= end_s + _AFTER_S:
            taken.append(self._turns.popleft())
        return frozen(np.array(taken).reshape(-1, 2)) if self._is_there else None
