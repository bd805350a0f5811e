"""The readings of an IMU in a bag or of a live robot: sensor_msgs/Imu."""

from typing import Any, Final, NamedTuple

import numpy as np

from fcslam.records import FloatArray, Transform
from fcslam.sources.bags.messages import header_of
from fcslam.sources.bags.transforms import NoTransformError, TransformTree

_LARGEST_RATE: Final = 35.0
"""A gyro that measures more, rad/s, is broken."""


class ImuReading(NamedTuple):
    """A reading in the axes of its sensor."""

    stamp: float
    frame: str
    values: tuple[float, ...]
    """Angular velocity in rad/s, and specific force in m/s^2."""


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
