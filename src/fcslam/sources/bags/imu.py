"""The readings of an IMU in a bag or of a live robot: sensor_msgs/Imu."""

from typing import Any, Final, NamedTuple

import numpy as np

from fcslam.records import FloatArray
from fcslam.sources.bags.messages import header_of
from fcslam.sources.bags.transforms import NoTransformError, TransformTree

_LARGEST_RATE: Final = 35.0
"""A gyro that measures more, rad/s, is broken."""


class ImuReading(NamedTuple):
    """A reading in the axes of the base, by the clock of the scans."""

    stamp: float
    values: tuple[float, ...]
    """Angular velocity in rad/s, and specific force in m/s^2."""


class ImuReader:
    """Reads messages in the axes of the base, as tf has them; a frame that tf lacks is taken as parallel."""

    def __init__(self, tree: TransformTree, base_frame: str, ahead_s: float) -> None:
        """The clock of the IMU is ``ahead_s`` ahead."""
        self._tree, self._base_frame, self._ahead_s = tree, base_frame, ahead_s
        self._rotations: dict[str, FloatArray] = {}

    def read(self, content: Any, bag_time_ns: int) -> ImuReading:
        """Convert a message; raises ValueError if it is invalid or has no angular velocity."""
        stamp, frame = header_of(content.header, bag_time_ns)
        if content.angular_velocity_covariance[0] == -1.0:
            raise ValueError("the IMU measures no angular velocity")
        rate, force = content.angular_velocity, content.linear_acceleration
        values = np.array(((rate.x, rate.y, rate.z), (force.x, force.y, force.z)))
        if not (np.isfinite(values).all() and np.abs(values[0]).max() < _LARGEST_RATE):
            raise ValueError("the angular velocity or the acceleration cannot be that of a robot")
        if frame not in self._rotations:
            try:
                self._rotations[frame] = self._tree.fixed(self._base_frame, frame).rotation_matrix()
            except NoTransformError:
                self._rotations[frame] = np.eye(3)
        turned = values @ self._rotations[frame].T
        return ImuReading(stamp - self._ahead_s, tuple(turned.ravel().tolist()))
