"""Calibration from motion: what the scans of a drive say about stamps, odometry and the mounting of the laser.

The scans are tracked without odometry. Their motion is then compared with that of odometry, by robust least squares:

- heading: ``turn_scale * (turn by odometry from t_k + delay to t_l + delay) = turn by the scans from k to l``;
- position: ``M C = C B`` with the motion M by odometry, B by the scans, and the correction C of the mounting (A. Censi
  et al., "Simultaneous calibration of odometry and sensor parameters for mobile robots", T-RO 2013);
- sweep: ``share * (turn by odometry in the assumed sweep) = turn in the sweep, as the scans were matched``.
"""

from dataclasses import dataclass, replace
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fcslam.geometry import se2
from fcslam.records import FloatArray

LEAST_MOVE_M: Final = 0.15
LEAST_TURN_RAD: Final = LEAST_MOVE_M
"""Two scans are compared once the robot has moved or turned by so much; the turn moves by as much what is at 1 m."""
LONGEST_S: Final = 2.0
"""Scans farther apart in time are not compared: odometry drifts."""
FEWEST_MOTIONS: Final = 20
"""Fewer turns say nothing about times, and fewer motions nothing about the mounting."""
FEWEST_PAIRS: Final = 5
"""Fewer turns or motions say nothing about the scales: two numbers are estimated from them."""
LARGEST_RESIDUAL_M: Final = 0.1 * LEAST_MOVE_M
"""Motions of scans and odometry that differ by more, as a standard deviation, are not a measure of each other."""
LARGEST_SIGMA: Final = 0.1
"""The same if the scale of distances is less certain, as a share of it: scans that were lost in a corridor."""
DELAY_STEP_S: Final = 0.01
LARGEST_DELAY_S: Final = 40 * DELAY_STEP_S
"""Range and step of the search for the delay, before it is refined."""
HUBER: Final = 1.5
"""Residuals beyond this many standard deviations count less."""
SIGMA_FACTOR: Final = 3.0
"""Factor of the standard deviations: consecutive residuals are correlated."""


Pairs = NDArray[np.int64]


class Estimate(NamedTuple):
    """A number that was estimated, and its standard deviation."""

    value: float
    sigma: float

    def differs(self, nominal: float, least: float, sigmas: float = 4.0) -> bool:
        """Whether it is significantly not ``nominal``, and by more than ``least``."""
        return abs(self.value - nominal) > max(least, sigmas * self.sigma)


Mounting = tuple[Estimate, Estimate, Estimate]


@dataclass(frozen=True, slots=True)
class ScanMotions:
    """The scans of a drive as they were tracked without odometry, N of them."""

    stamps: FloatArray
    """Shape (N,), seconds."""
    T_local_base: FloatArray
    """Poses at the stamps, shape (N, 3), metres and radians; NaN starts a new track."""
    turned_rad: FloatArray
    """Turn from the first beam to the last, shape (N,), as the scan was matched; NaN if it is unknown."""
    first_s: FloatArray
    last_s: FloatArray
    """Assumed times of the first and the last beam after the stamp, shape (N,)."""


@dataclass(frozen=True, slots=True)
class OdometryTrack:
    """Poses by wheel odometry with growing stamps."""

    stamps: FloatArray
    """Shape (M,), seconds."""
    T_odom_base: FloatArray
    """Shape (M, 3), headings unwrapped."""
    period_s: float = 0.0
    """Usual time between two updates."""

    def at(self, stamps: FloatArray) -> FloatArray:
        """Interpolated poses, shape (K, 3)."""
        return np.stack([np.interp(stamps, self.stamps, axis) for axis in self.T_odom_base.T], axis=1)


@dataclass(frozen=True, slots=True)
class MotionCalibration:
    """Estimates from a drive; None where it holds no information."""

    delay: Estimate | None = None
    """Time by the clock of the odometry at a stamp of the scans, less this stamp, seconds."""
    turn_scale: Estimate | None = None
    distance_scale: Estimate | None = None
    """Turn and distance by the scans per turn and distance by odometry."""
    mounting: Mounting | None = None
    """Correction of the pose of the laser, in ``base``: x and y in metres, heading in radians."""
    sweep_share: Estimate | None = None
    """True duration of a sweep per assumed duration."""


def calibrate(motions: ScanMotions, odometry: OdometryTrack) -> MotionCalibration:
    """Compare the motion of the scans with that of the odometry.

    A short drive has the scales alone: their standard deviations say whether they mean anything.
    """
    pairs = _pairs(motions)
    turns = np.count_nonzero(np.abs(_turn(motions, pairs)) > LEAST_TURN_RAD)
    delay, turn_scale = Estimate(0.0, 0.0), None
    if turns >= FEWEST_PAIRS:
        delay, turn_scale = _delay_and_scale(motions, odometry, pairs)
    if len(pairs) < FEWEST_PAIRS:
        return MotionCalibration(turn_scale=turn_scale)
    begins, ends = motions.stamps[pairs.T] + delay.value
    moved = se2.between(odometry.at(begins), odometry.at(ends))
    seen = se2.between(*motions.T_local_base[pairs.T])
    scale, mounting, residual_m = _fit(moved, seen, moved[:, 2] * (1.0 if turn_scale is None else turn_scale.value))
    distance_scale = _distance_scale(scale, moved, seen)
    scales = MotionCalibration(turn_scale=turn_scale, distance_scale=distance_scale)
    is_known = distance_scale.sigma <= LARGEST_SIGMA * distance_scale.value
    is_measure, is_long = is_known and residual_m <= LARGEST_RESIDUAL_M, len(pairs) >= FEWEST_MOTIONS
    if turns < FEWEST_MOTIONS or (is_long and not is_measure):
        return scales
    timed = replace(scales, delay=delay, sweep_share=_sweep_share(motions, odometry, delay.value))
    return replace(timed, mounting=mounting) if is_long else timed


def _pairs(motions: ScanMotions) -> Pairs:
    """Pairs (k, l) of scans of one track, one after the other, with enough motion between them, shape (P, 2)."""
    pairs: list[tuple[int, int]] = []
    first = 0
    poses, stamps = motions.T_local_base, motions.stamps
    for k in range(1, len(stamps)):
        step = se2.between(poses[first], poses[k])
        if np.isnan(step[0]) or stamps[k] - stamps[first] > LONGEST_S or stamps[k] <= stamps[first]:
            first = k
        elif abs(step[2]) > LEAST_TURN_RAD or np.hypot(step[0], step[1]) > LEAST_MOVE_M:
            pairs.append((first, k))
            first = k
    return np.array(pairs, dtype=np.int64).reshape(-1, 2)


def _turn(motions: ScanMotions, pairs: Pairs) -> FloatArray:
    return np.asarray(se2.wrap_angle(motions.T_local_base[pairs[:, 1], 2] - motions.T_local_base[pairs[:, 0], 2]))


def _delay_and_scale(motions: ScanMotions, odometry: OdometryTrack, pairs: Pairs) -> tuple[Estimate, Estimate]:
    """Gauss-Newton over the delay and the scale of turns, from the best delay of a search."""
    turned, begins, ends = _turn(motions, pairs), motions.stamps[pairs[:, 0]], motions.stamps[pairs[:, 1]]

    def turned_by_odometry(delay_s: float) -> FloatArray:
        return np.asarray(odometry.at(ends + delay_s)[:, 2] - odometry.at(begins + delay_s)[:, 2])

    delays = np.arange(-LARGEST_DELAY_S, LARGEST_DELAY_S + DELAY_STEP_S / 2, DELAY_STEP_S)
    delay_s = float(min(delays, key=lambda delay: float(np.abs(turned - turned_by_odometry(delay)).sum())))
    scale = 1.0
    covariance = np.eye(2)
    for _ in range(8):
        by_odometry = turned_by_odometry(delay_s)
        later, earlier = turned_by_odometry(delay_s + DELAY_STEP_S), turned_by_odometry(delay_s - DELAY_STEP_S)
        rate = scale * (later - earlier) / (2.0 * DELAY_STEP_S)
        step, covariance = _robust(np.stack((rate, by_odometry), axis=1), turned - scale * by_odometry)
        delay_s, scale = delay_s + float(step[0]), scale + float(step[1])
    sigmas = np.sqrt(np.diag(covariance))
    return Estimate(delay_s, float(sigmas[0])), Estimate(scale, float(sigmas[1]))


def _sweep_share(motions: ScanMotions, odometry: OdometryTrack, delay_s: float) -> Estimate | None:
    """Share of the assumed duration in which the beams were measured, by the turns in the sweeps."""
    known = np.isfinite(motions.turned_rad)
    stamps = motions.stamps[known] + delay_s
    by_odometry = odometry.at(stamps + motions.last_s[known])[:, 2] - odometry.at(stamps + motions.first_s[known])[:, 2]
    turning = np.abs(by_odometry) > 0.25 * LEAST_TURN_RAD
    if np.count_nonzero(turning) < FEWEST_MOTIONS:
        return None
    (share,), covariance = _robust(by_odometry[turning, None], motions.turned_rad[known][turning])
    return Estimate(float(share), float(np.sqrt(covariance[0, 0])))


def _fit(moved: FloatArray, seen: FloatArray, turned: FloatArray) -> tuple[Estimate, Mounting, float]:
    """Linear least squares of ``(R_m - I) c' + m = R(g) b / s``, with c = s c' and C = (c, g).

    Motions m and b between the same scans (P, 3) are ``moved`` and ``seen``; R_m turns by ``turned``, shape (P,).
    """
    cos, sin = np.cos(turned), np.sin(turned)
    rows_x = np.stack((1.0 - cos, sin, seen[:, 0], -seen[:, 1]), axis=1)
    rows_y = np.stack((-sin, 1.0 - cos, seen[:, 1], seen[:, 0]), axis=1)
    design, target = np.concatenate((rows_x, rows_y)), np.concatenate((moved[:, 0], moved[:, 1]))
    (x, y, a, b), covariance = _robust(design, target)
    scale = 1.0 / max(float(np.hypot(a, b)), 1e-9)
    sigma_x, sigma_y, sigma_a, sigma_b = np.sqrt(np.diag(covariance)).tolist()
    sigma = scale * float(np.hypot(sigma_a, sigma_b))
    mounting = (
        Estimate(float(scale * x), scale * sigma_x),
        Estimate(float(scale * y), scale * sigma_y),
        Estimate(float(np.arctan2(b, a)), sigma),
    )
    residual_m = 1.4826 * float(np.median(np.abs(target - design @ (x, y, a, b))))
    return Estimate(scale, scale * sigma), mounting, residual_m


def _distance_scale(forward: Estimate, moved: FloatArray, seen: FloatArray) -> Estimate:
    """Scale of distances, from the fit in both directions.

    Errors of ``seen`` make the scale of one fit too large, as where a corridor hides the motion along it, and that of
    the other too small. The true one is anywhere between them.
    """
    backward = 1.0 / _fit(seen, moved, seen[:, 2])[0].value
    sigma = np.hypot(forward.sigma, (forward.value - backward) / np.sqrt(12.0))
    return Estimate(float(np.sqrt(forward.value * backward)), float(sigma))


def _robust(design: FloatArray, target: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Huber's least squares of ``design x = target``, reweighted; returns x and its covariance."""
    weights = np.ones(len(target))
    for _ in range(10):
        normal = design.T @ (weights[:, None] * design) + 1e-9 * np.eye(design.shape[1])
        inverse = np.linalg.inv(normal)
        x = inverse @ (design.T @ (weights * target))
        residual = np.abs(target - design @ x)
        sigma = max(1.4826 * float(np.median(residual)), 1e-9)
        weights = np.asarray(np.minimum(1.0, HUBER * sigma / np.maximum(residual, 1e-12)))
    return x, np.asarray((SIGMA_FACTOR * sigma) ** 2 * inverse)
