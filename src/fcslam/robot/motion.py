"""The motion of a robot up to each scan and during it: measured by its wheels, or predicted where they say nothing."""

from collections.abc import Callable
from dataclasses import replace

from fcslam.geometry import se2
from fcslam.lidar.first_motion import LONGEST_GAP_S, first_sweep
from fcslam.lidar.frontend import LidarFrontend
from fcslam.lidar.lost import SEEN_S, is_in_reach, is_unplaced, relocated
from fcslam.lidar.odometry import WHEELS
from fcslam.lidar.tracker import TrackedScan, TrackingResult
from fcslam.records import CameraImage, FloatArray, LaserScan, Sweep, frozen
from fcslam.robot.motion_prediction import PREDICTED, MotionPrediction
from fcslam.robot.odometry_gate import OdometryGate, WheelCheck

InOdom = Callable[[TrackedScan], FloatArray]
"""Gives ``T_odom_base`` of a localized scan, shape (3,), in a frame without jumps."""
Deferred = list[LaserScan | CameraImage]
"""Records since the first doubtful scan, which is the first of them."""


class WheelOdometry:
    """Motion by wheel odometry. Scans and images carry it."""

    model = WHEELS

    def __init__(self, scan_duration_s: float) -> None:
        """``scan_duration_s`` is the duration of scans that do not state it."""
        self._scan_duration_s = scan_duration_s
        self._gate, self._check = OdometryGate(), WheelCheck()

    @property
    def jumps(self) -> int:
        """Jumps of the odometry so far, which are bridged."""
        return self._gate.jumps

    @property
    def fault(self) -> str | None:
        """Why it is not odometry, as the end of a sentence; None if it can be."""
        return self._check.fault

    @property
    def may_be_frozen(self) -> bool:
        """Whether it stands still although the newest scans have changed."""
        return self._check.may_be_frozen

    @property
    def certain_s(self) -> float:
        """Stamp of the newest scan at which it was certainly not frozen."""
        return self._check.certain_s

    def says_nothing(self, scan: LaserScan) -> bool:
        """Whether it says nothing up to the next scan, so that the motion must be predicted."""
        return self._check.say_nothing(scan)

    def place(self, scan: LaserScan, before: LaserScan | None) -> LaserScan:
        """The next scan with its pose free of jumps and the velocity during its sweep; ``before`` is the one before."""
        timed = _timed(scan, self._scan_duration_s)
        if timed is not scan and before is not None:
            timed = _moving_on(timed, before)
        return self._gate.scan(timed)

    def place_image(self, image: CameraImage) -> CameraImage:
        """An image taken since the last scan, with its pose free of jumps."""
        return self._gate.image(image)


class PredictedMotion:
    """Motion of a robot without odometry: the one of the last scans goes on, and scan matching corrects it."""

    model = PREDICTED

    def __init__(self, scan_duration_s: float) -> None:
        """``scan_duration_s`` is the duration of scans that do not state it."""
        self._scan_duration_s = scan_duration_s
        self._prediction = MotionPrediction()
        self._own_map: LidarFrontend | None = None
        """Matches doubtful scans with each other, from the second one on."""
        self._T_odom_first = se2.IDENTITY
        """Pose of the first one of them, shape (3,)."""

    def place(self, scan: LaserScan) -> LaserScan:
        """The next scan with the predicted pose and velocity."""
        return self._prediction.predict(_timed(scan, self._scan_duration_s))

    def place_image(self, image: CameraImage) -> CameraImage:
        """An image without a pose: the robot is taken to be where the last scan was made."""
        return replace(image, T_odom_base=None)

    def awaits_second(self, scan: LaserScan) -> bool:
        """Whether only a second scan shows the motion during this one."""
        return self._prediction.is_new and scan.sweep is not None

    def begin(self, deferred: Deferred, second: LaserScan, T_odom_first: FloatArray = se2.IDENTITY) -> LaserScan:
        """Give the first deferred scan the motion that the second one shows; returns this one, predicted from it."""
        first = deferred[0]
        assert isinstance(first, LaserScan)  # images are deferred only behind a scan
        deferred[0] = first = replace(first, sweep=first_sweep(first, second, PREDICTED))
        self._prediction.begin(first, T_odom_first)
        return self._prediction.predict(second)

    def track(self, scan: LaserScan, frontend: LidarFrontend, in_odom: InOdom) -> tuple[LaserScan, TrackingResult]:
        """Localize a scan, deskew it by the motion that was found, and localize it again."""
        tracking = frontend.localize(scan)
        if not tracking.tracked.information.any():
            return scan, tracking
        moving = self._prediction.moving(scan, in_odom(tracking.tracked))
        return (scan, tracking) if moving is scan else (moving, frontend.localize(moving))

    def observe(self, stamp: float, T_odom_base: FloatArray, tracked: TrackedScan) -> None:
        """Predict the next scan from where the one at ``stamp`` was found; see ``MotionPrediction.observe``."""
        self._prediction.observe(stamp, T_odom_base if tracked.information.any() else None, tracked.sweep)

    def follow(
        self, deferred: Deferred, scan: LaserScan, tracked: TrackedScan, frontend: LidarFrontend, in_odom: InOdom
    ) -> LaserScan:
        """The next doubtful scan with its motion.

        The first one is where the map has it. As they may show another place, the others are matched with each other.
        """
        if not deferred:
            self._own_map, self._T_odom_first = None, in_odom(tracked)
            return self._prediction.follow(scan, self._T_odom_first, tracked.sweep)
        origin = self._T_odom_first
        if self._own_map is None:
            scan = self.begin(deferred, scan, origin)
            self._own_map = frontend.fresh()
            self._own_map.process(_scans(deferred)[0])
        scan, own = self.track(scan, self._own_map, lambda tracked: se2.compose(origin, tracked.T_local_base))
        scan = self._prediction.follow(scan, se2.compose(origin, own.tracked.T_local_base), own.tracked.sweep)
        self._own_map.process(scan, own._replace(T_odom_base=scan.T_odom_base))
        return scan

    def relocate(self, deferred: Deferred, frontend: LidarFrontend, gap_s: float) -> bool:
        """Move doubtful scans to where the newest keyscans show them; whether they show the place before them.

        Args:
            deferred: the scans, and the images between them.
            frontend: the robot's front end; it does not change.
            gap_s: time before them in which nothing shows the motion; 0: there was no gap.
        """
        scans = _scans(deferred)
        found = relocated(scans, frontend)
        if found is None or not is_in_reach(found, scans[0], frontend, gap_s):
            is_elsewhere = found is not None and not gap_s
            return not (is_elsewhere or gap_s > SEEN_S or is_unplaced(scans[0], frontend))
        T = se2.compose(frontend.T_odom_base(found), se2.inverse(scans[0].T_odom_base))
        self._prediction.move(T)
        for number, record in enumerate(deferred):
            if isinstance(record, LaserScan):
                deferred[number] = replace(record, T_odom_base=frozen(se2.compose(T, record.T_odom_base)))
        return True


Motion = WheelOdometry | PredictedMotion


def _scans(deferred: Deferred) -> list[LaserScan]:
    return [record for record in deferred if isinstance(record, LaserScan)]


def _timed(scan: LaserScan, duration_s: float) -> LaserScan:
    """The scan with the times of its beams, if it does not state them and ``duration_s`` is not 0."""
    return scan if scan.sweep is not None or duration_s <= 0.0 else replace(scan, sweep=Sweep(0.0, duration_s))


def _moving_on(scan: LaserScan, before: LaserScan) -> LaserScan:
    """The scan with the velocity since the one before, by odometry, in its sweep."""
    elapsed_s = scan.stamp - before.stamp
    if scan.sweep is None or not 0.0 < elapsed_s <= LONGEST_GAP_S:
        return scan
    x, y, theta = (se2.log(se2.between(before.T_odom_base, scan.T_odom_base)) / elapsed_s).tolist()
    return replace(scan, sweep=scan.sweep._replace(velocity=(x, y, theta)))
