"""Motion of a robot without wheel odometry: the one of the last scans goes on, and scan matching corrects it."""

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from fcslam.geometry import se2
from fcslam.lidar.first_motion import LONGEST_GAP_S, first_sweep
from fcslam.lidar.frontend import LidarFrontend
from fcslam.lidar.gyro import Gyro
from fcslam.lidar.lost import SEEN_S, is_in_reach, is_unplaced, relocated
from fcslam.lidar.odometry import PREDICTED
from fcslam.lidar.tracker import TrackedScan, TrackingResult
from fcslam.records import CameraImage, FloatArray, LaserScan, Sweep, frozen

LEAST_SHARE, LARGEST_SHARE = 0.5, 3.0
"""Limits of the next motion as a share of the last one: intervals vary by dropped scans, but also by wrong stamps."""
InOdom = Callable[[TrackedScan], FloatArray]
"""Gives ``T_odom_base`` of a localized scan, shape (3,), in a frame without jumps."""
Deferred = list[LaserScan | CameraImage]
"""Records since the first doubtful scan, which is the first of them."""


class PredictedMotion:
    """Stands in for the odometry of a robot: its velocity stays constant, and scan matching corrects it.

    The velocity is that in the sweep of the last scan, or between the last two if measured at once. A gyro measures the
    turns.
    """

    model, jumps, may_be_frozen = PREDICTED, 0, False

    def __init__(self) -> None:
        self._T_odom_base = self._T_odom_last = np.zeros(3)
        """Odometry of the newest scan and of the previous one."""
        self._motion = np.zeros(3)
        """Between the last two scans, in the tangent space of the base (x, y, theta)."""
        self._elapsed_s = 0.0
        """Time between them."""
        self._last: tuple[float, FloatArray] | None = None
        """Stamp and pose of the last scan in a frame without jumps, if it was matched."""
        self._sweep: Sweep | None = None
        """The sweep of the last scan, as it was matched."""
        self._is_new = True
        """Whether the robot has not begun to move."""
        self._gyro = Gyro()
        self._own_map: LidarFrontend | None = None
        """Matches doubtful scans with each other, from the second one on."""
        self._T_odom_first = se2.IDENTITY
        """Pose of the first one of them, shape (3,)."""

    def place(self, scan: LaserScan) -> LaserScan:
        """The next scan with its pose in a frame of the prediction's own, and with the motion during its sweep."""
        elapsed_s = 0.0 if self._last is None else scan.stamp - self._last[0]
        self._gyro.add(scan)
        self._T_odom_last = self._T_odom_base
        if self._last is None or not elapsed_s <= LONGEST_GAP_S:
            return replace(scan, T_odom_base=frozen(self._T_odom_base))
        sweep = scan.sweep
        if self._sweep is not None and self._goes_on(elapsed_s):
            motion = self._sweep.displacement(elapsed_s)
            if sweep is not None:
                sweep = sweep._replace(velocity=self._sweep.velocity)
        elif self._elapsed_s > 0.0:
            share = min(max(elapsed_s / self._elapsed_s, LEAST_SHARE), LARGEST_SHARE)
            motion = se2.exp(share * self._motion)
            if sweep is not None:
                x, y, theta = (self._motion / self._elapsed_s).tolist()
                sweep = sweep._replace(velocity=(x, y, theta))
        else:
            motion = np.zeros(3)
        if scan.gyro is not None:
            angles = self._gyro.angles(np.array([self._last[0], scan.stamp]))
            motion = motion if angles is None else np.array([*motion[:2], angles[1]])
            sweep = sweep and self._gyro.turning(sweep, scan.stamp)
        self._T_odom_base = se2.compose(self._T_odom_base, motion)
        return replace(scan, T_odom_base=frozen(self._T_odom_base), sweep=sweep)

    def place_image(self, image: CameraImage) -> CameraImage:
        """An image with the pose to which the motion of the last scans goes on; None if they do not tell it."""
        share = -1.0 if self._last is None or not self._elapsed_s else (image.stamp - self._last[0]) / self._elapsed_s
        if not 0.0 <= share <= LARGEST_SHARE:
            return replace(image, T_odom_base=None)
        return replace(image, T_odom_base=frozen(se2.compose(self._T_odom_base, se2.exp(share * self._motion))))

    def awaits_second(self, scan: LaserScan) -> bool:
        """Whether only a second scan shows the motion during this one."""
        return self._is_new and scan.sweep is not None

    def begin(self, deferred: Deferred, second: LaserScan, T_odom_first: FloatArray = se2.IDENTITY) -> LaserScan:
        """Give the first deferred scan the motion that the second one shows; returns this one, predicted from it."""
        first = deferred[0]
        assert isinstance(first, LaserScan)  # images are deferred only behind a scan
        deferred[0] = first = replace(first, sweep=first_sweep(first, second, PREDICTED))
        self._is_new, self._last, self._sweep = False, (first.stamp, T_odom_first), first.sweep
        self._T_odom_base = first.T_odom_base
        return self.place(second)

    def track(self, scan: LaserScan, frontend: LidarFrontend, in_odom: InOdom) -> tuple[LaserScan, TrackingResult]:
        """Localize a scan, deskew it by the motion that was found, and localize it again.

        A velocity that was taken over from sweep to sweep may be wrong and fit nevertheless, as all surfaces around are
        distorted alike. The poses at the stamps show the true one.
        """
        tracking = frontend.localize(scan)
        elapsed_s = math.inf if self._last is None else scan.stamp - self._last[0]
        is_matched = tracking.tracked.information.any()
        if self._last is None or scan.sweep is None or not is_matched or not self._goes_on(elapsed_s):
            return scan, tracking
        x, y, theta = (se2.log(se2.between(self._last[1], in_odom(tracking.tracked))) / elapsed_s).tolist()
        sweep = scan.sweep._replace(velocity=(x, y, theta))
        moving = replace(scan, sweep=sweep if scan.gyro is None else self._gyro.turning(sweep, scan.stamp))
        return moving, frontend.localize(moving)

    def observe(self, stamp: float, T_odom_base: FloatArray, tracked: TrackedScan) -> None:
        """Predict the next scan from where the one at ``stamp`` was found: a pose in a frame without jumps, shape (3,).

        If it was not matched, the robot is assumed to stand still, as a wrong velocity would lead ever further.
        """
        self._observe(stamp, T_odom_base if tracked.information.any() else None, tracked.sweep)

    def follow(
        self, deferred: Deferred, scan: LaserScan, tracked: TrackedScan, frontend: LidarFrontend, in_odom: InOdom
    ) -> LaserScan:
        """The next doubtful scan with its motion.

        The first one is where the map has it. As they may show another place, the others are matched with each other.
        """
        if not deferred:
            self._own_map, self._T_odom_first = None, in_odom(tracked)
            return self._found(scan, self._T_odom_first, tracked.sweep)
        origin = self._T_odom_first
        if self._own_map is None:
            scan = self.begin(deferred, scan, origin)
            self._own_map = frontend.fresh()
            self._own_map.process(scans_of(deferred)[0])
        scan, own = self.track(scan, self._own_map, lambda tracked: se2.compose(origin, tracked.T_local_base))
        scan = self._found(scan, se2.compose(origin, own.tracked.T_local_base), own.tracked.sweep)
        self._own_map.process(scan, own._replace(state=own.state._replace(T_odom_base=scan.T_odom_base)))
        return scan

    def relocate(self, deferred: Deferred, frontend: LidarFrontend, gap_s: float) -> bool:
        """Move doubtful scans to where the newest keyscans show them; whether they show the place before them.

        ``gap_s`` is the time before them in which nothing shows the motion; 0: there was no gap.
        """
        scans = scans_of(deferred)
        found = relocated(scans, frontend)
        if found is None or not is_in_reach(found, scans[0], frontend, gap_s):
            is_elsewhere = found is not None and not gap_s
            return not (is_elsewhere or gap_s > SEEN_S or is_unplaced(scans[0], frontend))
        T = se2.compose(frontend.tracker.T_odom_base(found), se2.inverse(scans[0].T_odom_base))
        self._T_odom_base, self._T_odom_last = se2.compose(T, self._T_odom_base), se2.compose(T, self._T_odom_last)
        for number, record in enumerate(deferred):
            if isinstance(record, LaserScan):
                deferred[number] = replace(record, T_odom_base=frozen(se2.compose(T, record.T_odom_base)))
        return True

    def _goes_on(self, elapsed_s: float) -> bool:
        """Whether the motion in the last sweep tells that in the next one, ``elapsed_s`` later."""
        return self._sweep is not None and 0.0 < elapsed_s <= LARGEST_SHARE * self._sweep.duration_s

    def _found(self, scan: LaserScan, T_smooth_base: FloatArray, sweep: Sweep | None) -> LaserScan:
        """A scan that waits for a decision, with its motion as it was found; the next prediction goes on from there."""
        motion = np.zeros(3) if self._last is None else se2.between(self._last[1], T_smooth_base)
        self._T_odom_base = se2.compose(self._T_odom_last, motion)
        self._observe(scan.stamp, T_smooth_base, sweep)
        return replace(scan, T_odom_base=frozen(self._T_odom_base), sweep=sweep)

    def _observe(self, stamp: float, T_smooth_base: FloatArray | None, sweep: Sweep | None) -> None:
        """The pose (3,) at which a scan was found, and its sweep as it was matched; None: it was not matched."""
        elapsed_s = math.inf if self._last is None else stamp - self._last[0]
        self._is_new, self._elapsed_s, self._sweep = False, 0.0, None
        if self._last is not None and T_smooth_base is not None and 0.0 <= elapsed_s <= LONGEST_GAP_S:
            self._sweep = sweep
            if elapsed_s > 0.0:  # otherwise it is the same scan, in the map of another session
                self._motion = se2.log(se2.between(self._last[1], T_smooth_base))
                self._elapsed_s = elapsed_s
                self._gyro.learn(self._last[0], stamp, float(self._motion[2]))
        self._last = None if T_smooth_base is None else (stamp, T_smooth_base)


def scans_of(deferred: Deferred) -> list[LaserScan]:
    """The scans among deferred records."""
    return [record for record in deferred if isinstance(record, LaserScan)]
