"""Walls that look bent show that a laser does not measure distances: its zero is off, or its ranges are not linear.

A wall has the ranges ``1 / (a cos(angle) + b sin(angle))``. Where all ranges are longer by ``c``, the wall is bent; so
each stretch of a wall gives an estimate of ``c`` by least squares. The estimates from other things scatter around zero.
"""

import math
from collections.abc import Iterable, Iterator
from itertools import groupby, islice, pairwise
from typing import Final, NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from fcslam.geometry import se2
from fcslam.records import FloatArray, LaserModel, LaserScan, Ranges

MOST_SCANS: Final = 300
"""Scans that are examined at most."""
SCANS_TOGETHER: Final = 20
"""Scans whose stretches are fitted at a time; more would take memory."""
LEAST_MOVE_M, LEAST_TURN_RAD = 0.3, 0.3
"""The robot has moved or turned by so much between two of them."""
LARGEST_TURN_RAD: Final = 0.03
"""Between a scan and the one before; a scanner that spins sees bent walls while it turns faster."""
STRETCH_RAD: Final = math.radians(40.0)
"""Angle of the stretches, as the laser sees them; each begins a quarter of it after the one before."""
FEWEST_BEAMS: Final = 12
LEAST_RETURNS: Final = 0.9
"""Share of the beams of a stretch."""
STEP_M, STEP_SHARE = 0.1, 0.15
"""Ranges side by side that differ by more, plus by this share, see two things."""
STRAIGHT_M: Final = 0.03
"""Deviation from a wall, root mean square, up to which a stretch is one."""
LEAST_NOISE_M: Final = 0.005
LARGEST_SIGMA_M: Final = 0.08
"""Largest standard deviation of the estimate from a stretch."""
FARTHEST_M: Final = 1000.0
STEPS: Final = 6
"""Of Gauss-Newton."""
FEWEST_STRETCHES: Final = 30
LEAST_EXCESS_M, OTHERS = 0.1, 25.0
"""Excess that is said, and per cent of the stretches that may show less."""


class Excess(NamedTuple):
    """By how much the ranges of a laser are too long; below 0: too short."""

    short_m: float
    """A short range as it was measured."""
    at_short_m: float
    """Excess of such a range."""
    long_m: float
    at_long_m: float

    def __str__(self) -> str:
        """What is wrong, and what to do."""
        wrong = "long" if self.at_short_m > 0.0 else "short"
        return (
            f"the walls in the scans are bent, as if ranges were too {wrong} by {abs(self.at_short_m):.2f} m at "
            f"{self.short_m:.1f} m and by {abs(self.at_long_m):.2f} m at {self.long_m:.1f} m; "
            "correct the zero of the laser in its driver, the conversion of its values to metres, or the angles of the "
            "beams"
        )


def excess_of(scans: Iterable[LaserScan]) -> Excess | None:
    """By how much the ranges of a laser are too long, if most walls show it; None if they are straight, or few."""
    examined = enumerate(islice(scans_apart(_steady(scans)), MOST_SCANS))
    groups = groupby(examined, lambda each: (each[0] // SCANS_TOGETHER, each[1].laser))
    stretches = (_stretches(laser, [scan.ranges_m for _, scan in same]) for (_, laser), same in groups)
    ranges_m, excess_m = np.concatenate([np.empty((0, 2)), *stretches]).T
    if len(ranges_m) < FEWEST_STRETCHES:
        return None
    if np.percentile(np.copysign(1.0, np.median(excess_m)) * excess_m, OTHERS) < LEAST_EXCESS_M:
        return None
    short, long = np.array_split(np.argsort(ranges_m), 2)
    return Excess(*(float(np.median(each[half])) for half in (short, long) for each in (ranges_m, excess_m)))


def scans_apart(scans: Iterable[LaserScan]) -> Iterator[LaserScan]:
    """Scans between which the robot has moved or turned, by odometry."""
    last: LaserScan | None = None
    for scan in scans:
        if last is not None:
            x, y, theta = se2.between(last.T_odom_base, scan.T_odom_base).tolist()
            if not (math.hypot(x, y) > LEAST_MOVE_M or abs(theta) > LEAST_TURN_RAD):  # also without odometry
                continue
        last = scan
        yield scan


def _steady(scans: Iterable[LaserScan]) -> Iterator[LaserScan]:
    """Scans during which the robot turns slowly."""
    for before, scan in pairwise(scans):
        if abs(se2.wrap_angle(scan.T_odom_base[2] - before.T_odom_base[2])) < LARGEST_TURN_RAD:
            yield scan


def _stretches(laser: LaserModel, scans: list[Ranges]) -> FloatArray:
    """Middle range and excess of each stretch of a wall in scans with the same beams, shape (N, 2), metres."""
    count = round(STRETCH_RAD / abs(laser.angle_increment_rad))
    if count < FEWEST_BEAMS or laser.beam_count < count:
        return np.empty((0, 2))
    windows = sliding_window_view(np.array(scans, np.float64), count, axis=1)[:, :: count // 4]
    ranges_m = windows.reshape(-1, count)
    seen = (ranges_m > 0.0) & (ranges_m < laser.max_range_m)
    ranges_m = np.where(seen, ranges_m, 1.0)
    steps_m = np.abs(np.diff(ranges_m, axis=1))
    is_step = (steps_m > STEP_M + STEP_SHARE * ranges_m[:, 1:]) & seen[:, 1:] & seen[:, :-1]
    chosen = (seen.mean(axis=1) > LEAST_RETURNS) & ~is_step.any(axis=1)
    seen, ranges_m = seen[chosen], ranges_m[chosen]
    excess_m = _excess(np.asarray(laser.angle_increment_rad * (np.arange(count) - 0.5 * count)), ranges_m, seen)
    return np.column_stack((np.median(ranges_m, axis=1), excess_m))[np.isfinite(excess_m)]


def _excess(angles: FloatArray, ranges_m: FloatArray, seen: NDArray[np.bool_]) -> FloatArray:
    """By how much the ranges of walls are too long, shape (N,); NaN if they are of no wall, or do not tell.

    Args:
        angles: shape (B,), radians.
        ranges_m: shape (N, B).
        seen: which of them count.
    """
    directions = np.stack((np.cos(angles), np.sin(angles)), axis=1)
    wall = _solved(directions * (ranges_m * seen)[:, :, None], seen.astype(np.float64))[0]
    excess_m = np.zeros(len(ranges_m))
    for _ in range(STEPS):
        inverse = np.maximum(wall @ directions.T, 1.0 / FARTHEST_M)
        residual_m = seen * (ranges_m - excess_m[:, None] - 1.0 / inverse)
        slopes = np.concatenate((-directions / inverse[:, :, None] ** 2, np.ones((*inverse.shape, 1))), axis=2)
        change, covariance = _solved(slopes * seen[:, :, None], residual_m)
        wall, excess_m = wall + change[:, :2], excess_m + change[:, 2]
    rms_m = np.sqrt((residual_m**2).sum(axis=1) / seen.sum(axis=1))
    sigma_m = np.maximum(rms_m, LEAST_NOISE_M) * np.sqrt(covariance[:, 2, 2])
    is_wall = (rms_m < STRAIGHT_M) & (sigma_m < LARGEST_SIGMA_M) & (inverse.min(axis=1) > 1.0 / FARTHEST_M)
    return np.where(is_wall, excess_m, np.nan)


def _solved(design: FloatArray, target: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Least squares of ``design x = target`` in each row, and the inverses of their normal matrices."""
    turned = design.transpose(0, 2, 1)
    inverse = np.asarray(np.linalg.pinv(turned @ design, hermitian=True))
    return (inverse @ (turned @ target[:, :, None]))[:, :, 0], inverse
