"""Evidence of a scan match against wheel odometry, counted by surfaces instead of points.

Outdoors a scanner sees the ground: a line of returns across the path, which travels with the robot. Its many points fit
wherever the ground was seen before, so the sum over points would overrule any odometry. But they are one surface, and
one surface may move. So a match that contradicts odometry, or leaves a part of the scan unexplained, is compared with
another one. That trusts odometry as far as it was right so far.
"""

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from fcslam.geometry import se2
from fcslam.lidar.field import SurfelField
from fcslam.lidar.matching import FIXED, ScanMatch, match_scan
from fcslam.lidar.odometry import PRIOR_TAIL, OdometryError
from fcslam.lidar.scan import PointScan
from fcslam.records import FloatArray

CLEAR, LEAST_KNOWN = 0.8, 0.5
"""Least share of the points in known area that a clear match explains; least share of all points in known area. The
part that an unclear match does not explain may be the only one that stands still."""
NEAR = 2.0
FAR = 2.0 * NEAR
"""A match agrees with odometry up to the first and contradicts it from the second, in sigmas of its learned error."""
LEAST_SIGMA_M, SIGMA_PER_TURN = 0.025, 0.1
LEAST_SIGMA_RAD = LEAST_SIGMA_M / 2.5
"""Least standard deviations of odometry that a match is judged by, metres and radians, and their growth per radian of
turn. Matches have an error of their own, and the learned error is mostly that of small turns."""
LEAST_STEP_M = 0.25
"""Travel within which the errors of odometry are not independent, metres."""
CORRELATED = 10.0
"""Points of a scan that count as one in the match that trusts odometry: errors of neighbouring points are correlated.
As points count fully in the matcher, odometry's information is raised instead."""
SURFACE_NATS = 4.0
"""Largest log-likelihood that one surface adds or takes: beyond it, the surface itself may have moved."""
CLEAR_GAIN = 3.0
"""Log-probability that a clear match against odometry has beforehand over one that trusts odometry: it is wrong only
where a single surface, as the ground, lies across the whole path. So it is less than that of a surface."""
GAP_M = 1.0
"""Neighbouring returns farther apart than this lie on two surfaces."""
CORNER: Final = float(np.cos(np.radians(35.0)))
"""Neighbouring normals with a smaller dot product lie on two surfaces."""


def over_steps(error: OdometryError, moved_m: float, step_m: float) -> OdometryError:
    """Error of odometry over several steps whose errors are independent.

    ``error`` is that of all steps if they erred the same way; they moved by ``moved_m``, the last one by ``step_m``.
    """
    share = math.sqrt(min(1.0, max(step_m, LEAST_STEP_M) / max(moved_m, LEAST_STEP_M)))
    return OdometryError(share * error.position_m, share * error.heading_rad)


def judged_by(learned: OdometryError, turned_rad: float) -> OdometryError:
    """Error of odometry that a match is judged by, after a turn that odometry measured, radians."""
    return OdometryError(
        max(LEAST_SIGMA_M + SIGMA_PER_TURN * turned_rad, learned.position_m),
        max(LEAST_SIGMA_RAD + SIGMA_PER_TURN * turned_rad, learned.heading_rad),
    )


def resolve(
    scan: PointScan,
    field: SurfelField,
    T_field_guess: FloatArray,
    match: ScanMatch,
    learned: OdometryError,
    turned_rad: float,
    velocity_information: FloatArray = FIXED,
) -> tuple[ScanMatch, bool]:
    """Choose between a match that hardly trusts odometry and one that trusts it as far as it was right so far.

    Args:
        scan, field, velocity_information: as in ``match_scan``.
        T_field_guess: the pose by odometry, shape (3,), metres and radians.
        match: the match that hardly trusts odometry.
        learned: the error of odometry as learned from earlier matches.
        turned_rad: turn that odometry measured, radians.

    Returns:
        The chosen match, and whether the scan contradicts odometry that is chosen, so that nothing is learned from it.
    """
    error = judged_by(learned, turned_rad)
    innovation = se2.motion(T_field_guess, match.T_field_base)
    distance2 = error.mahalanobis2(innovation)
    is_far, is_seen = distance2 >= FAR**2, match.known >= LEAST_KNOWN
    is_clear = is_seen and match.explained >= CLEAR * match.known
    if distance2 < NEAR**2 or (is_clear and not is_far):
        return match, False
    prior = CORRELATED * error.information
    trusting = match_scan(scan, field, T_field_guess, prior, velocity_information)
    gains = surface_gains(scan, match.log_likelihoods - trusting.log_likelihoods)
    if is_far and is_seen and gains.max(initial=0.0) <= SURFACE_NATS:  # no surface alone pulls the match: wheels slip
        trusting = match_scan(scan, field, T_field_guess, prior, velocity_information, prior_tail=PRIOR_TAIL)
        gains = surface_gains(scan, match.log_likelihoods - trusting.log_likelihoods)
    gain = float(np.clip(gains, -SURFACE_NATS, SURFACE_NATS).sum())
    gain += error.log_likelihood(innovation)
    gain -= error.log_likelihood(se2.motion(T_field_guess, trusting.T_field_base))
    gain += CLEAR_GAIN * is_clear
    return (match, False) if gain > 0.0 and (is_seen or not is_far) else (trusting, is_far)


def surface_gains(scan: PointScan, gains: FloatArray) -> FloatArray:
    """Sum of the points' gains (N,) on each surface of a scan, shape (S,).

    Points without a normal do not count: rough ground has none, and at corners they belong to two surfaces.
    """
    return np.bincount(surfaces(scan), gains * scan.normals.any(axis=1)).astype(np.float64)


def surfaces(scan: PointScan) -> NDArray[np.intp]:
    """Number of each return's surface, shape (N,): a row of returns between two gaps or corners."""
    if not len(scan):
        return np.zeros(0, np.intp)
    ends = np.hypot(*np.diff(scan.points, axis=0).T) > GAP_M
    facing = np.flatnonzero(scan.normals.any(axis=1))
    agreement = (scan.normals[facing[1:]] * scan.normals[facing[:-1]]).sum(axis=1)
    ends[facing[1:][agreement < CORNER] - 1] = True
    return np.concatenate(([0], np.cumsum(ends)))
