"""Motion of a robot without wheel odometry: the one of the last scans goes on, and scan matching corrects it."""

import math
from dataclasses import replace

import numpy as np

from fcslam.geometry import se2
from fcslam.lidar.first_motion import LONGEST_GAP_S
from fcslam.lidar.odometry import OdometryModel
from fcslam.records import FloatArray, LaserScan, Sweep, frozen

LEAST_SHARE, LARGEST_SHARE = 0.5, 3.0
"""Limits of the next motion as a share of the last one: intervals vary if scans are dropped, but also if stamps are
wrong."""
PREDICTED = OdometryModel(
    is_measured=False,
    position_m=0.1,
    position_per_travel=0.5,
    heading_rad=0.1,
    heading_per_turn=0.5,
)
"""Model of a robot without odometry: every scan is matched, and the prediction is trusted little. Within a tenth of a
second, a robot may brake or turn by so much."""


class MotionPrediction:
    """Stands in for the odometry of a robot, with constant velocity.

    It is the velocity in the sweep of the last scan, or that between the last two scans if they were measured at once.
    """

    def __init__(self) -> None:
        self._T_odom_base = np.zeros(3)
        """Of the newest scan."""
        self._T_odom_last = np.zeros(3)
        """Of the scan before."""
        self._motion = np.zeros(3)
        """Between the last two scans, in the tangent space of the base (x, y, theta)."""
        self._elapsed_s = 0.0
        """Time between them."""
        self._last: tuple[float, FloatArray] | None = None
        """Stamp and pose of the last scan, if it was matched."""
        self._sweep: Sweep | None = None
        """The sweep of the last scan, as it was matched."""
        self.is_new = True
        """Whether the robot has not begun to move."""

    def begin(self, first: LaserScan, T_smooth_base: FloatArray) -> None:
        """Go on from a scan whose sweep has the robot's motion; its pose, shape (3,), as in ``observe``."""
        self.is_new, self._last, self._sweep = False, (first.stamp, T_smooth_base), first.sweep
        self._T_odom_base = first.T_odom_base

    def predict(self, scan: LaserScan) -> LaserScan:
        """The next scan with its pose in a frame of the prediction's own, and with the motion during its sweep."""
        elapsed_s = 0.0 if self._last is None else scan.stamp - self._last[0]
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
        self._T_odom_base = se2.compose(self._T_odom_base, motion)
        return replace(scan, T_odom_base=frozen(self._T_odom_base), sweep=sweep)

    def _goes_on(self, elapsed_s: float) -> bool:
        """Whether the motion in the last sweep tells that in the next one, ``elapsed_s`` later."""
        return self._sweep is not None and 0.0 < elapsed_s <= LARGEST_SHARE * self._sweep.duration_s

    def moving(self, scan: LaserScan, T_smooth_base: FloatArray) -> LaserScan:
        """A scan that was found at ``T_smooth_base``, with the velocity from the scan before to there in its sweep.

        A velocity that was taken over from sweep to sweep may be wrong and fit nevertheless, as all surfaces around are
        distorted alike. The poses at the stamps show the true one.
        """
        elapsed_s = math.inf if self._last is None else scan.stamp - self._last[0]
        if self._last is None or scan.sweep is None or not self._goes_on(elapsed_s):
            return scan
        x, y, theta = (se2.log(se2.between(self._last[1], T_smooth_base)) / elapsed_s).tolist()
        return replace(scan, sweep=scan.sweep._replace(velocity=(x, y, theta)))

    def follow(self, scan: LaserScan, T_smooth_base: FloatArray, sweep: Sweep | None) -> LaserScan:
        """A scan that waits for a decision, with its motion as it was found; the next prediction goes on from there.

        Args:
            scan: the scan, predicted.
            T_smooth_base, sweep: as in ``observe``.
        """
        motion = np.zeros(3) if self._last is None else se2.between(self._last[1], T_smooth_base)
        self._T_odom_base = se2.compose(self._T_odom_last, motion)
        self.observe(scan.stamp, T_smooth_base, sweep)
        return replace(scan, T_odom_base=frozen(self._T_odom_base), sweep=sweep)

    def move(self, T: FloatArray) -> None:
        """Move the frame of the predictions by ``T``, shape (3,), as the robot was found elsewhere."""
        self._T_odom_base, self._T_odom_last = se2.compose(T, self._T_odom_base), se2.compose(T, self._T_odom_last)

    def observe(self, stamp: float, T_smooth_base: FloatArray | None, sweep: Sweep | None) -> None:
        """Where the tracker found the scan.

        Args:
            stamp: of the scan, seconds.
            T_smooth_base: its pose in a frame without jumps, shape (3,), metres and radians. None: it was not matched;
                then the robot is assumed to stand still, as a wrong velocity would take it ever further.
            sweep: the sweep as it was matched.
        """
        elapsed_s = math.inf if self._last is None else stamp - self._last[0]
        self.is_new, self._elapsed_s, self._sweep = False, 0.0, None
        if self._last is not None and T_smooth_base is not None and 0.0 <= elapsed_s <= LONGEST_GAP_S:
            self._sweep = sweep
            if elapsed_s > 0.0:  # otherwise it is the same scan, in the map of another session
                self._motion = se2.log(se2.between(self._last[1], T_smooth_base))
                self._elapsed_s = elapsed_s
        self._last = None if T_smooth_base is None else (stamp, T_smooth_base)
