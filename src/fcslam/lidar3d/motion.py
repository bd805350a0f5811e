"""The motion of a robot during and between turns of its 3D LiDAR, as other sensors measure it.

Wheels give the path in the plane of the floor, the gyro of an IMU all rotations. Without either, the robot goes on as
it did. Registration then says how far this was wrong: scales of the wheels and the bias of the gyro are learned.
"""

from typing import Final, NamedTuple

import numpy as np

from fcslam.compiled import njit
from fcslam.geometry import se2, se3
from fcslam.lidar.gyro import GYRO_NOISE, KEPT_S, GyroBias, covers, integral, newest
from fcslam.lidar.odometry import OdometryModel, OdometryTrust, odometry_error
from fcslam.records import CloudScan, FloatArray

_ACCELERATION: Final = np.array([1.0, 1.0, 1.0, 3.0, 3.0, 5.0])
"""Standard deviation of the acceleration of a robot without other sensors, m/s^2 and rad/s^2: x, y, z, then about
each."""
_UNKNOWN: Final = np.array([1.0, 1.0, 0.3, 0.3, 0.3, 1.5])
"""The same of the velocity before anything is known about it, m/s and rad/s."""
_WHEELS: Final = OdometryModel(
    position_m=0.005, position_per_travel=0.1, position_per_turn_m=0.02, heading_rad=0.01, heading_per_turn=0.2
)
"""Model of the error of wheels during a turn of the LiDAR, a few centimetres of travel."""
_TILT_RAD, _TILT_PER_M = 1e-3, 0.02
"""Standard deviation of roll and pitch, which wheels do not measure: of a turn of the LiDAR, and per metre, as a floor
bends under a robot that drives. Heights are as certain as positions."""
_GYRO_RAD, _GYRO_SHARE = 1e-3, 0.01
"""Standard deviation of a rotation by gyro: of a turn of the LiDAR, and per radian."""
_AT_REST: Final = 1e-3
"""Metres and radians in a turn below which a robot stands still."""


class Prediction(NamedTuple):
    """Motion over some times."""

    poses: FloatArray
    """Pose at each time in the frame of the robot at the first, shape (K, 7)."""
    sigma: FloatArray
    """Standard deviations of the last, in its tangent, shape (6,)."""
    planar: se2.Pose | None
    """The last by wheels alone, as they measured it; None without wheels."""
    rotation: FloatArray | None
    """The integral of the gyro, bias included, shape (3,), radians; None without a gyro."""


class MotionSensors:
    """The newest readings of the wheels and the IMU of a robot, and what was learned about them."""

    def __init__(self) -> None:
        self.velocity: FloatArray = np.zeros(6)
        """Velocity of the newest turn, m/s and rad/s in the axes of the robot."""
        self.trust = OdometryTrust()
        self.bias = GyroBias(np.zeros(3))
        self._is_moving_known = False
        self._wheels, self._imu = np.zeros((0, 4)), np.zeros((0, 7))

    def add(self, scan: CloudScan) -> None:
        """Take the readings that came with a turn."""
        self._wheels = newest(self._wheels, scan.wheels, scan.stamp - KEPT_S)
        self._imu = newest(self._imu, scan.imu, scan.stamp - KEPT_S)

    def predict(self, times: FloatArray, by_wheels: bool = True) -> Prediction:
        """The motion over ascending ``times`` (K,), seconds, by the wheels or as if there were none."""
        spans = np.diff(times)
        moves, turns = spans[:, None] * self.velocity[:3], spans[:, None] * self.velocity[3:]
        length_s = times[-1] - times[0]
        sigma = length_s * (_ACCELERATION * max(length_s, 0.05) if self._is_moving_known else _UNKNOWN)
        planar = rotation = None
        if by_wheels and covers(self._wheels, times):
            path = self._path(times)
            planar = se2.motion(path[0], path[-1])
            steps = np.array([self.trust.distance.value] * 2 + [self.trust.turn.value]) * se2.relative(path)
            moves = np.column_stack((steps[:, :2], np.zeros(len(steps))))
            turns = np.column_stack((np.zeros((len(steps), 2)), steps[:, 2]))
            moved_m = float(np.hypot(*planar[:2]))
            error = self.trust.scale(odometry_error(moved_m, abs(planar[2]), _WHEELS))
            tilt_rad = _TILT_RAD + _TILT_PER_M * moved_m
            sigma = np.array([*3 * [error.position_m], *2 * [tilt_rad], error.heading_rad])
        if covers(self._imu, times):
            turned = integral(self._imu[:, 0], self._imu[:, 1:4], times)
            rotation = turned[-1]
            turns = np.diff(turned, axis=0) - spans[:, None] * self.bias.value
            spread = np.sqrt(self.bias.variance) * length_s
            sigma[3:] = _GYRO_RAD + spread + _GYRO_SHARE * np.linalg.norm(rotation)
        return Prediction(_chain(moves, turns), np.maximum(sigma, 1e-5), planar, rotation)

    def learn(
        self, predicted: Prediction, motion: FloatArray, moved: FloatArray | None, length_s: float, sigma_rad: float
    ) -> None:
        """Learn from the motion (7,) that registration found for a prediction over ``length_s``.

        ``moved`` (7,) is from the predicted begin on, where most of a small error of the wheels is found; None if the
        surfaces do not fix it in every direction. ``sigma_rad`` is the standard deviation of the rotation.
        """
        tangent = se3.log(motion)
        self.velocity, self._is_moving_known = tangent / length_s, True
        if predicted.planar is not None and moved is not None:
            planar = predicted.planar
            error = odometry_error(float(np.hypot(*planar[:2])), abs(planar[2]), _WHEELS)
            found = se2.motion(np.array(self.trust.motion(planar)), se3.to_plane(moved))
            self.trust = self.trust.learn(found, error, planar)
        if predicted.rotation is not None:
            rests = np.linalg.norm(predicted.planar or tangent) < _AT_REST
            turned = np.zeros(3) if rests else tangent[3:]
            sigma = GYRO_NOISE if rests else GYRO_NOISE + sigma_rad / length_s
            self.bias = self.bias.learn((predicted.rotation - turned) / length_s, sigma)

    def _path(self, times: FloatArray) -> FloatArray:
        stamps = self._wheels[:, 0]
        headings = np.unwrap(self._wheels[:, 3])
        return np.column_stack([np.interp(times, stamps, each) for each in (*self._wheels[:, 1:3].T, headings)])


@njit
def _chain(moves, turns):  # type: ignore[no-untyped-def]
    """Poses (K, 7) after steps: translations (K - 1, 3) and rotation vectors (K - 1, 3), each in the frame before."""
    poses = np.zeros((len(moves) + 1, 7))
    poses[0, 6] = 1.0
    for k in range(len(moves)):
        x, y, z, w = poses[k, 3:]
        # half of the step's rotation turns its translation
        for part in range(2):
            rx, ry, rz = 0.5 * turns[k]
            angle = np.sqrt(rx * rx + ry * ry + rz * rz)
            s = 0.5 if angle < 1e-8 else np.sin(0.5 * angle) / angle
            qx, qy, qz, qw = s * rx, s * ry, s * rz, np.cos(0.5 * angle)
            x, y, z, w = (
                w * qx + x * qw + y * qz - z * qy,
                w * qy - x * qz + y * qw + z * qx,
                w * qz + x * qy - y * qx + z * qw,
                w * qw - x * qx - y * qy - z * qz,
            )
            if part == 0:
                vx, vy, vz = moves[k]
                cx, cy, cz = 2.0 * (y * vz - z * vy), 2.0 * (z * vx - x * vz), 2.0 * (x * vy - y * vx)
                poses[k + 1, 0] = poses[k, 0] + vx + w * cx + y * cz - z * cy
                poses[k + 1, 1] = poses[k, 1] + vy + w * cy + z * cx - x * cz
                poses[k + 1, 2] = poses[k, 2] + vz + w * cz + x * cy - y * cx
        poses[k + 1, 3], poses[k + 1, 4], poses[k + 1, 5], poses[k + 1, 6] = x, y, z, w
    return poses
