"""Rigid motions between two places that many of their keypoint matches support (two-point RANSAC, all pairs tried).

A hypothesis is a proposal: its inlier count says little about whether it is true. ``lidar.verification`` decides.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fcslam.compiled import njit
from fcslam.features.codes import Matches
from fcslam.records import FloatArray, frozen

_REFINEMENTS = 5
"""Most rounds of least squares and inlier selection. The inliers nearly always stop changing after two or three."""
SEEDS = 50
"""Closest matches that seed the search: every two of them propose a motion."""
INLIER_M = 0.3
"""Largest distance between the matched keypoints of an inlier, metres."""
MINIMUM_INLIERS = 4
"""Fewest inliers of a motion hypothesis."""
MOST_HYPOTHESES = 2
"""Most motion hypotheses of a pair of places."""
DISTINCT_M = 1.0
"""Distance of two motion hypotheses, in metres, from which on they are distinct."""
DISTINCT_RAD = 0.26
"""Angle between two motion hypotheses, in radians, from which on they are distinct."""


@dataclass(frozen=True, slots=True)
class Hypothesis:
    """A rigid motion and its inliers."""

    T_a_b: FloatArray
    """Shape (3,): x, y in metres and theta in radians; takes coordinates of place b to place a."""
    inliers: NDArray[np.int64]
    """Shape (K,): rows of ``matches.pairs``, ascending."""

    @property
    def inlier_count(self) -> int:
        """Number of inliers."""
        return len(self.inliers)


class _Limits(NamedTuple):
    """The part of the configuration that compiled code needs."""

    inlier_distance_m: float
    minimum_inliers: int
    most: int
    distinct_distance_m: float
    distinct_angle_rad: float


def rigid_hypotheses(
    keypoints_a: NDArray[np.float32], keypoints_b: NDArray[np.float32], matches: Matches
) -> list[Hypothesis]:
    """Find the motions that most matches support, the best first.

    Every two of the ``SEEDS`` closest matches propose a motion (two-point alignment). All matches score it, and least
    squares over the inliers refines the best. The search is deterministic and never proposes a reflection.

    Args:
        keypoints_a: shape (N, 2), metres in place a's coordinate frame.
        keypoints_b: shape (M, 2), metres in place b's coordinate frame.
        matches: pairs of their indices.

    Returns:
        At most ``MOST_HYPOTHESES``; an empty list if no motion has ``MINIMUM_INLIERS``.
    """
    if len(matches.pairs) < MINIMUM_INLIERS:
        return []
    a = keypoints_a[matches.pairs[:, 0]].astype(np.float64)
    b = keypoints_b[matches.pairs[:, 1]].astype(np.float64)
    seeds = np.argsort(matches.distances, kind="stable")[:SEEDS]
    trials = _trials(a, b, seeds, INLIER_M)
    limits = _Limits(
        INLIER_M,
        MINIMUM_INLIERS,
        MOST_HYPOTHESES,
        DISTINCT_M,
        DISTINCT_RAD,
    )
    poses, agreeing = _best(a, b, trials, limits)
    return [
        Hypothesis(frozen(pose), frozen(np.flatnonzero(agrees), np.int64))
        for pose, agrees in zip(poses, agreeing, strict=True)
    ]


@njit
def _trials(a: FloatArray, b: FloatArray, seeds: NDArray[np.int64], tolerance_m: float) -> FloatArray:
    """Motions of every two seeds whose keypoints are equally far apart in both places: rows x, y, theta, score.

    Pairs of keypoints closer than twice the tolerance are skipped, because they do not determine the angle.
    """
    trials = np.empty((seeds.shape[0] * (seeds.shape[0] - 1) // 2, 4))
    count = 0
    for p in range(1, seeds.shape[0]):
        for q in range(p):
            i, j = seeds[p], seeds[q]
            ax, ay = a[j, 0] - a[i, 0], a[j, 1] - a[i, 1]
            bx, by = b[j, 0] - b[i, 0], b[j, 1] - b[i, 1]
            length_a, length_b = np.hypot(ax, ay), np.hypot(bx, by)
            if min(length_a, length_b) < 2.0 * tolerance_m or abs(length_a - length_b) > tolerance_m:
                continue
            cos = (bx * ax + by * ay) / (length_a * length_b)
            sin = (bx * ay - by * ax) / (length_a * length_b)
            middle_x, middle_y = 0.5 * (b[i, 0] + b[j, 0]), 0.5 * (b[i, 1] + b[j, 1])
            x = 0.5 * (a[i, 0] + a[j, 0]) - (cos * middle_x - sin * middle_y)
            y = 0.5 * (a[i, 1] + a[j, 1]) - (sin * middle_x + cos * middle_y)
            trials[count, 0], trials[count, 1], trials[count, 2] = x, y, np.arctan2(sin, cos)
            trials[count, 3] = _score(a, b, (x, y, cos, sin), tolerance_m)
            count += 1
    return trials[:count]


@njit
def _score(a: FloatArray, b: FloatArray, motion: tuple[float, float, float, float], tolerance_m: float) -> float:
    """Sum over the inliers of 1 - (distance / tolerance)^2 (MSAC): smaller residuals break ties of the inlier count."""
    x, y, cos, sin = motion
    score = 0.0
    scale = 1.0 / tolerance_m**2
    for k in range(a.shape[0]):
        dx = x + cos * b[k, 0] - sin * b[k, 1] - a[k, 0]
        dy = y + sin * b[k, 0] + cos * b[k, 1] - a[k, 1]
        score += max(0.0, 1.0 - scale * (dx * dx + dy * dy))
    return score


@njit
def _best(a: FloatArray, b: FloatArray, trials: FloatArray, limits: _Limits) -> tuple[FloatArray, NDArray[np.bool_]]:
    """Refine the best trials one after another and suppress trials near a hypothesis that was found before."""
    scores = trials[:, 3].copy()
    poses = np.empty((limits.most, 3))
    agreeing = np.empty((limits.most, a.shape[0]), np.bool_)
    found = 0
    while found < limits.most and scores.shape[0]:
        best = np.argmax(scores)
        if scores[best] <= 0.0:
            break
        pose, agrees = _refine(a, b, trials[best, :3], limits.inlier_distance_m)
        scores[best] = 0.0
        if agrees.sum() < limits.minimum_inliers or _near(pose, poses[:found], limits):
            continue
        poses[found], agreeing[found] = pose, agrees
        found += 1
        for index in range(scores.shape[0]):
            if _near(trials[index], pose.reshape(1, 3), limits):
                scores[index] = 0.0
    return poses[:found], agreeing[:found]


@njit
def _near(pose: FloatArray, others: FloatArray, limits: _Limits) -> bool:
    for index in range(others.shape[0]):
        turn = abs(pose[2] - others[index, 2])
        turn = min(turn, 2.0 * np.pi - turn)
        if (
            np.hypot(pose[0] - others[index, 0], pose[1] - others[index, 1]) <= limits.distinct_distance_m
            and turn <= limits.distinct_angle_rad
        ):
            return True
    return False


@njit
def _refine(a: FloatArray, b: FloatArray, pose: FloatArray, tolerance_m: float) -> tuple[FloatArray, NDArray[np.bool_]]:
    agrees = _agreeing(a, b, pose, tolerance_m)
    for _ in range(_REFINEMENTS):
        refined = _least_squares(a, b, agrees)
        now = _agreeing(a, b, refined, tolerance_m)
        if now.sum() < agrees.sum():
            break
        unchanged = (now == agrees).all()
        pose, agrees = refined, now
        if unchanged:
            break
    return pose, agrees


@njit
def _agreeing(a: FloatArray, b: FloatArray, pose: FloatArray, tolerance_m: float) -> NDArray[np.bool_]:
    cos, sin = np.cos(pose[2]), np.sin(pose[2])
    dx = pose[0] + cos * b[:, 0] - sin * b[:, 1] - a[:, 0]
    dy = pose[1] + sin * b[:, 0] + cos * b[:, 1] - a[:, 1]
    agrees: NDArray[np.bool_] = dx * dx + dy * dy <= tolerance_m * tolerance_m
    return agrees


@njit
def _least_squares(a: FloatArray, b: FloatArray, agrees: NDArray[np.bool_]) -> FloatArray:
    """The rigid motion with the least squared distances, from the centred sums of products."""
    n = agrees.sum()
    ax, ay = (a[:, 0] * agrees).sum() / n, (a[:, 1] * agrees).sum() / n
    bx, by = (b[:, 0] * agrees).sum() / n, (b[:, 1] * agrees).sum() / n
    dot = cross = 0.0
    for k in range(a.shape[0]):
        if agrees[k]:
            dot += (a[k, 0] - ax) * (b[k, 0] - bx) + (a[k, 1] - ay) * (b[k, 1] - by)
            cross += (b[k, 0] - bx) * (a[k, 1] - ay) - (b[k, 1] - by) * (a[k, 0] - ax)
    theta = np.arctan2(cross, dot)
    cos, sin = np.cos(theta), np.sin(theta)
    return np.array([ax - (cos * bx - sin * by), ay - (sin * bx + cos * by), theta])
