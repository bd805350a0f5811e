"""The readings of an IMU in a bag or of a live robot: sensor_msgs/Imu."""

from collections import deque
from collections.abc import Iterable, Iterator
from typing import Any, Final, NamedTuple

import numpy as np

from fcslam.records import FloatArray, Transform, frozen
from fcslam.sources.bags.camera import ImageMessage
from fcslam.sources.bags.codec import IMU
from fcslam.sources.bags.container import Topic
from fcslam.sources.bags.messages import OdometryReading, ScanMessage, header_of
from fcslam.sources.bags.pairing import MAX_GAP_S, Entry, Message, PosedImage, PosedScan
from fcslam.sources.bags.robots import BagRobot
from fcslam.sources.bags.transforms import NoTransformError, TransformTree
from fcslam.sources.pose import UNKNOWN_POSE

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

    def row(self, reading: ImuReading) -> list[float]:
        """Stamp, angular velocity and specific force in the axes of the base."""
        if reading.frame not in self._rotations:
            try:
                turn: Transform = self._tree.fixed(self._base_frame, reading.frame)
                self._rotations[reading.frame] = turn.rotation_matrix()
            except NoTransformError:
                self._rotations[reading.frame] = np.eye(3)
        rotation = self._rotations[reading.frame]
        return [reading.stamp, *rotation @ reading.values[:3], *rotation @ reading.values[3:]]

    def turn(self, reading: ImuReading, ahead_s: float) -> tuple[float, float]:
        """Stamp and angular velocity about the vertical, of a sensor whose clock is ``ahead_s`` ahead."""
        stamp, _, _, rate_rad_s, *_ = self.row(reading)
        return stamp - ahead_s, rate_rad_s


class GyroPairing:
    """Gives each scan of a robot without odometry the readings of its gyro since the scan before, if it has one.

    A scan waits for the readings during its sweep, but not for a gyro that is silent, nor longer than the next scan
    takes.
    """

    def __init__(self, turns: Iterable[tuple[float, float]] = ()) -> None:
        """``turns`` are the readings that are known: stamps, and angular velocities about the vertical."""
        self._turns = deque(turns)
        self._newest_s = self._turns[-1][0] if self._turns else -np.inf
        self._queue: deque[tuple[int, ScanMessage | ImageMessage]] = deque()

    @property
    def waiting(self) -> int:
        """Number of scans and images that wait."""
        return len(self._queue)

    def turn(self, stamp: float, rate_rad_s: float) -> Iterator[tuple[int, Entry]]:
        """Add a reading; yields what waits no longer."""
        self._turns.append((stamp, rate_rad_s))
        self._newest_s = stamp
        yield from self._complete()

    def add(self, number: int, item: Message) -> Iterator[tuple[int, Entry]]:
        """Add the next scan or image; yields those that wait no longer, in their order."""
        if not isinstance(item, OdometryReading):
            self._queue.append((number, item))
            yield from self._complete()

    def flush(self) -> Iterator[tuple[int, Entry]]:
        """Yield all that wait."""
        while self._queue:
            number, item = self._queue.popleft()
            if isinstance(item, ImageMessage):
                yield number, PosedImage(item, None)
            else:
                yield number, PosedScan(item, UNKNOWN_POSE, None, self._taken(item.end + _AFTER_S))

    def _complete(self) -> Iterator[tuple[int, Entry]]:
        item = self._queue[-1][1] if self._queue else None
        if isinstance(item, ScanMessage) and item.stamp - MAX_GAP_S < self._newest_s < item.end:
            latest = self._queue.pop()
            yield from self.flush()
            self._queue.append(latest)
        else:
            yield from self.flush()

    def _taken(self, until_s: float) -> FloatArray | None:
        if not np.isfinite(self._newest_s):
            return None
        taken: list[tuple[float, float]] = []
        while self._turns and self._turns[0][0] <= until_s:
            taken.append(self._turns.popleft())
        return frozen(np.array(taken).reshape(-1, 2))
