"""The motion of a robot up to each scan and during it: by wheel odometry, or predicted if that says nothing."""

from collections.abc import Callable
from dataclasses import replace

from fcslam.geometry import se2
from fcslam.lidar.first_motion import LONGEST_GAP_S
from fcslam.lidar.frontend import LidarFrontend
from fcslam.lidar.odometry import WHEELS, OdometryModel
from fcslam.lidar.tracker import TrackedScan, TrackingResult
from fcslam.records import CameraImage, FloatArray, LaserScan, Sweep
from fcslam.robot.motion_prediction import PREDICTED, MotionPrediction
from fcslam.robot.odometry_gate import OdometryGate, WheelCheck


class RobotMotion:
    """Gives every scan the pose from which its match starts, and the velocity by which its points are deskewed."""

    def __init__(self, scan_duration_s: float) -> None:
        """Begin with wheel odometry. ``scan_duration_s`` is the duration of scans that do not state it."""
        self.odometry = OdometryGate()
        self.wheels = WheelCheck()
        self.prediction: MotionPrediction | None = None
        """Stands in for the odometry; None if there is odometry."""
        self._scan_duration_s = scan_duration_s

    @property
    def model(self) -> OdometryModel:
        """Error of the odometry, or of the prediction in its place."""
        return WHEELS if self.prediction is None else PREDICTED

    @property
    def may_be_frozen(self) -> bool:
        """Whether the odometry in use stands still although the newest scans have changed."""
        return self.prediction is None and self.wheels.may_be_frozen

    def becomes_predicted(self, scan: LaserScan) -> bool:
        """Whether the odometry is found to say nothing with the next scan; from then on the motion is predicted."""
        if self.prediction is not None or not self.wheels.say_nothing(scan):
            return False
        self.prediction = MotionPrediction()
        return True

    def forget(self) -> None:
        """Predict from rest again: nothing is known of the motion to the next scan."""
        self.prediction = None if self.prediction is None else MotionPrediction()

    def predict(self, scan: LaserScan, before: LaserScan | None) -> LaserScan:
        """The next scan with its odometry free of jumps, or with a prediction; ``before`` is the one before it."""
        if scan.sweep is None and self._scan_duration_s > 0.0:
            scan = replace(scan, sweep=Sweep(0.0, self._scan_duration_s))
            if self.prediction is None and before is not None:
                scan = _moving_on(scan, before)
        return self.odometry.scan(scan) if self.prediction is None else self.prediction.predict(scan)

    def image(self, image: CameraImage) -> CameraImage:
        """An image taken since the last scan, with its odometry free of jumps, or with none."""
        return self.odometry.image(image) if self.prediction is None else replace(image, T_odom_base=None)

    def track(
        self, scan: LaserScan, frontend: LidarFrontend, in_smooth: Callable[[TrackedScan], FloatArray]
    ) -> tuple[LaserScan, TrackingResult]:
        """Localize a scan; without odometry, deskew it by the motion that was found, and localize it again.

        Args:
            scan: the scan, predicted.
            frontend: localizes it.
            in_smooth: gives the pose of the localized scan in the frame without jumps of ``observe``, shape (3,).
        """
        tracking = frontend.localize(scan)
        if self.prediction is None or not tracking.tracked.information.any():
            return scan, tracking
        moving = self.prediction.moving(scan, in_smooth(tracking.tracked))
        return (scan, tracking) if moving is scan else (moving, frontend.localize(moving))

    def observe(self, stamp: float, T_smooth_base: FloatArray, tracked: TrackedScan) -> None:
        """Predict the next scan from where the one at ``stamp`` was found; as ``MotionPrediction.observe``."""
        if self.prediction is not None:
            self.prediction.observe(stamp, T_smooth_base if tracked.information.any() else None, tracked.sweep)


def _moving_on(scan: LaserScan, before: LaserScan) -> LaserScan:
    """The scan with the velocity since the one before, by odometry, in its sweep."""
    elapsed_s = scan.stamp - before.stamp
    if scan.sweep is None or not 0.0 < elapsed_s <= LONGEST_GAP_S:
        return scan
    x, y, theta = (se2.log(se2.between(before.T_odom_base, scan.T_odom_base)) / elapsed_s).tolist()
    return replace(scan, sweep=scan.sweep._replace(velocity=(x, y, theta)))
