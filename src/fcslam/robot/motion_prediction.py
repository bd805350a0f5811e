"""Motion of a robot without wheel odometry: the one of the last scans goes on, and scan matching corrects it."""

import numpy as np

from fcslam.geometry import se2
from fcslam.lidar.odometry import OdometryConfig
from fcslam.records import FloatArray, frozen
from fcslam.robot.frontend import RobotConfig

LONGEST_S = 1.0
"""After a longer gap between two scans the robot is assumed to stand still: nothing is known of its motion."""
LEAST_SHARE, LARGEST_SHARE = 0.5, 3.0
"""Limits of the next motion as a share of the last one: intervals vary if scans are dropped, but also if stamps are
wrong."""
ERRORS = OdometryConfig(
    is_measured=False,
    position_m=0.1,
    position_per_travel=0.5,
    heading_rad=0.1,
    heading_per_turn=0.5,
)
"""Errors of the prediction: within a tenth of a second, a robot may brake or turn by so much."""


def without_odometry(config: RobotConfig) -> RobotConfig:
    """The settings of a robot without odometry: every scan is matched, and the prediction is trusted little."""
    tracker = config.lidar.tracker.model_copy(update={"still_m": 0.0, "still_rad": 0.0, "odometry": ERRORS})
    return config.model_copy(update={"lidar": config.lidar.model_copy(update={"tracker": tracker})})


class MotionPrediction:
    """Stands in for the odometry of a robot, with constant velocity."""

    def __init__(self) -> None:
        self._T_odom_base = np.zeros(3)
        self._motion = np.zeros(3)
        """Between the last two scans, in the tangent space of the base (x, y, theta)."""
        self._elapsed_s = 0.0
        """Time between them."""
        self._last: tuple[float, FloatArray] | None = None
        """Stamp and pose of the last scan, if it was matched."""

    def predict(self, stamp: float) -> FloatArray:
        """Pose at the next scan, in a frame of its own, shape (3,), metres and radians."""
        elapsed_s = 0.0 if self._last is None else stamp - self._last[0]
        if elapsed_s <= LONGEST_S and self._elapsed_s > 0.0:
            share = min(max(elapsed_s / self._elapsed_s, LEAST_SHARE), LARGEST_SHARE)
            self._T_odom_base = se2.compose(self._T_odom_base, se2.exp(share * self._motion))
        return frozen(self._T_odom_base)

    def observe(self, stamp: float, T_smooth_base: FloatArray | None) -> None:
        """Where the tracker found the scan.

        Args:
            stamp: of the scan, seconds.
            T_smooth_base: its pose in a frame without jumps, shape (3,), metres and radians. None: it was not matched;
                then the robot is assumed to stand still, as a wrong velocity would take it ever further.
        """
        self._elapsed_s = 0.0
        if self._last is not None and T_smooth_base is not None and 0.0 < stamp - self._last[0] <= LONGEST_S:
            self._motion = se2.log(se2.between(self._last[1], T_smooth_base))
            self._elapsed_s = stamp - self._last[0]
        self._last = None if T_smooth_base is None else (stamp, T_smooth_base)
