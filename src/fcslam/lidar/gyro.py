"""The gyro of an IMU: rotation between any two times, and the bias, which is learned."""

from dataclasses import dataclass
from typing import Final

import numpy as np

from fcslam.records import FloatArray, LaserScan, Sweep

KEPT_S: Final = 2.0
"""Older readings are forgotten."""
_HELD_S: Final = 0.1
"""The newest reading counts as long as this."""
FEWEST_READINGS: Final = 5
_BIAS_SIGMA, _BIAS_DRIFT, GYRO_NOISE = 0.02, 1e-4, 0.005
"""Standard deviations of the bias before it is learned, of its change from scan to scan, and of a reading, rad/s."""
_MATCHED_RAD: Final = 3e-3
"""Standard deviation of a turn between two scans that were matched."""
_WRONG_RAD, _MOST_WRONG = 0.1, 10
"""A gyro with a larger error in this many scans, less those where it is right, measures something else."""


@dataclass(frozen=True, slots=True)
class GyroBias:
    """Bias of a gyro as a Kalman filter knows it."""

    value: FloatArray
    variance: float = _BIAS_SIGMA**2

    def learn(self, measured: FloatArray, sigma: float) -> "GyroBias":
        """Learn from a measurement of the bias, shape (3,), rad/s."""
        variance = self.variance + _BIAS_DRIFT**2
        gain = variance / (variance + sigma**2)
        return GyroBias(self.value + gain * (measured - self.value), (1.0 - gain) * variance)


class Gyro:
    """The gyro of a robot in the plane: it turns where no wheels say how."""

    def __init__(self) -> None:
        self._readings: FloatArray = np.zeros((0, 2))
        self._bias = GyroBias(np.zeros(1))
        self._wrong = 0

    def add(self, scan: LaserScan) -> None:
        """Take the readings that came with a scan."""
        if scan.gyro is not None:
            self._readings = newest(self._readings, scan.gyro, scan.stamp - KEPT_S)

    def angles(self, times: FloatArray) -> FloatArray | None:
        """Heading at ``times`` (K,) relative to the first, shape (K,), radians; None if it is not known."""
        if self._wrong > _MOST_WRONG or not covers(self._readings, times):
            return None
        found: FloatArray = integral(self._readings[:, 0], self._readings[:, 1:], times)[:, 0]
        found -= self._bias.value[0] * (times - times[0])
        return found

    def turning(self, sweep: Sweep, stamp: float) -> Sweep:
        """A sweep with the turn that the gyro measured in it, if it did."""
        times = np.linspace(sweep.first_s, sweep.last_s, FEWEST_READINGS)
        order = np.argsort(times)
        angles = self.angles(stamp + times[order])
        if angles is None:
            return sweep
        # the heading at the stamp is that of the motion, which may be before the first beam
        terms = np.column_stack((np.ones(len(times)), times[order], 0.5 * times[order] ** 2))
        _, rate, change = np.linalg.lstsq(terms, angles, rcond=None)[0].tolist()
        (vx, vy, _), (ax, ay, _) = sweep.velocity, sweep.acceleration
        return sweep._replace(velocity=(vx, vy, rate), acceleration=(ax, ay, change))

    def learn(self, begin_s: float, end_s: float, turn_rad: float) -> None:
        """Learn from a turn between two scans that were matched."""
        angles = self.angles(np.array([begin_s, end_s]))
        if angles is None:
            return
        off_rad = float(angles[1]) - turn_rad
        self._wrong = max(0, self._wrong + (1 if abs(off_rad) > _WRONG_RAD else -1))
        self._bias = self._bias.learn(
            self._bias.value + off_rad / (end_s - begin_s), GYRO_NOISE + _MATCHED_RAD / (end_s - begin_s)
        )


def newest(old: FloatArray, new: FloatArray, since: float) -> FloatArray:
    """Readings since a time, in the order of their stamps; a clock that steps back begins anew."""
    if len(old) and len(new) and new[-1, 0] < old[-1, 0] - KEPT_S:
        old = old[:0]
    both = np.concatenate((old[max(0, np.searchsorted(old[:, 0], since) - 1) :], new))
    return both[np.argsort(both[:, 0], kind="stable")]


def covers(readings: FloatArray, times: FloatArray) -> bool:
    """Whether there are readings over all of ascending ``times``."""
    if len(readings) < FEWEST_READINGS:
        return False
    return bool(readings[0, 0] <= times[0] + _HELD_S and readings[-1, 0] >= times[-1] - _HELD_S)


def integral(stamps: FloatArray, rates: FloatArray, times: FloatArray) -> FloatArray:
    """Integral of ``rates`` (M, D) at ``stamps`` (M,) from the first of ``times`` (K,) to each, shape (K, D)."""
    areas = np.diff(stamps)[:, None] * (rates[1:] + rates[:-1]) / 2.0
    sums = np.vstack((np.zeros(rates.shape[1]), np.cumsum(areas, axis=0)))
    at = np.column_stack([np.interp(times, stamps, column) for column in sums.T])
    beyond = times[:, None] - np.clip(times, stamps[0], stamps[-1])[:, None]
    at += beyond * np.where(beyond < 0.0, rates[0], rates[-1])
    since: FloatArray = at - at[0]
    return since
