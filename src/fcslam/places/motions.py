"""Planar motions between two places that many of their keypoint matches support (two-point RANSAC, all pairs tried).

A hypothesis is a proposal: its inlier count says little about whether it is true. ``lidar.verification`` decides.
LiDAR keypoints are points in the plane. Keypoints of images also have a height. Robots drive on one floor, so matching
keypoints must have the same height, and the motion is planar as well.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from fcslam.compiled import assign, njit
from fcslam.features.codes import LARGEST_HAMMING, Matches, mutual_matches
from fcslam.geometry import se2
from fcslam.graph.evidence import DISTINCT_M, DISTINCT_RAD
from fcslam.records import Channel, FloatArray, Place, frozen

_REFINEMENTS = 5
"""Most rounds of least squares and inlier selection. The inliers nearly always stop changing after two or three."""
SEEDS = 50
"""Closest matches that seed the search: every two of them propose a motion."""
INLIER_M = 0.3
"""Largest distance between the matched keypoints of an inlier, metres."""
LEAST_INLIERS = 8
"""Fewest inliers of a motion, which the submaps then verify."""
MOST_HYPOTHESES = 2
"""Most motion hypotheses of a pair of places."""
INDEPENDENT_KEYPOINTS: Final = 10
"""Most independent keypoints of one image. The errors of its keypoints are correlated, because they share one scan and
one robot pose, so more keypoints do not add information."""
LARGEST_LEVEL_M = 0.1
"""Largest difference in height of two matching image keypoints, metres."""
KEYPOINT_SIGMA_M = 0.1
"""Standard deviation of the position of an image keypoint, metres."""


Hypothesis = tuple[FloatArray, NDArray[np.int64]]
"""A rigid motion (3,), x, y in metres and theta in radians, which takes coordinates of place b to place a; and its
inliers, rows of ``matches.pairs``, shape (K,), ascending."""


def rigid_hypotheses(
    keypoints_a: NDArray[np.float32], keypoints_b: NDArray[np.float32], matches: Matches
) -> list[Hypothesis]:
    """The motions that most matches of keypoints (N, 2) and (M, 2) support, the best first.

    Every two of the ``SEEDS`` closest matches propose a motion (two-point alignment). All matches score it, and least
    squares over the inliers refines the best. The search is deterministic and never proposes a reflection. There are at
    most ``MOST_HYPOTHESES``, and none without ``LEAST_INLIERS``. Keypoints are in metres in their place's coordinate
    frame.
    """
    if len(matches.pairs) < LEAST_INLIERS:
        return []
    a = keypoints_a[matches.pairs[:, 0]].astype(np.float64)
    b = keypoints_b[matches.pairs[:, 1]].astype(np.float64)
    seeds = np.argsort(matches.distances, kind="stable")[:SEEDS]
    poses, agreeing = _best(a, b, seeds)
    return [
        (frozen(pose), frozen(np.flatnonzero(agrees), np.int64)) for pose, agrees in zip(poses, agreeing, strict=True)
    ]


@njit
def _trials(a: FloatArray, b: FloatArray, seeds: NDArray[np.int64]) -> FloatArray:
    """Motions of every two seeds whose keypoints are equally far apart in both places: columns of x, y, cos, sin.

    Pairs of keypoints closer than twice ``INLIER_M`` are skipped, because they do not determine the angle.
    """
    trials = np.empty((4, seeds.shape[0] * (seeds.shape[0] - 1) // 2))
    count = 0
    for p in range(1, seeds.shape[0]):
        for q in range(p):
            i, j = seeds[p], seeds[q]
            ax, ay = a[j, 0] - a[i, 0], a[j, 1] - a[i, 1]
            bx, by = b[j, 0] - b[i, 0], b[j, 1] - b[i, 1]
            length_a, length_b = np.sqrt(ax * ax + ay * ay), np.sqrt(bx * bx + by * by)
            if min(length_a, length_b) < 2.0 * INLIER_M or abs(length_a - length_b) > INLIER_M:
                continue
            cos = (bx * ax + by * ay) / (length_a * length_b)
            sin = (bx * ay - by * ax) / (length_a * length_b)
            middle_x, middle_y = 0.5 * (b[i, 0] + b[j, 0]), 0.5 * (b[i, 1] + b[j, 1])
            trials[0, count] = 0.5 * (a[i, 0] + a[j, 0]) - (cos * middle_x - sin * middle_y)
            trials[1, count] = 0.5 * (a[i, 1] + a[j, 1]) - (sin * middle_x + cos * middle_y)
            trials[2, count], trials[3, count] = cos, sin
            count += 1
    return trials[:, :count].copy()


@njit
def _scores(a: FloatArray, b: FloatArray, trials: FloatArray) -> FloatArray:
    """Sum over the inliers of 1 - (distance / ``INLIER_M``)^2 (MSAC): smaller residuals break ties of their count.

    The inner loop is over the trials, so that the compiler vectorises it.
    """
    x, y, cos, sin = trials[0], trials[1], trials[2], trials[3]
    scores = np.zeros(trials.shape[1])
    scale = 1.0 / INLIER_M**2
    for k in range(a.shape[0]):
        ax, ay, bx, by = a[k, 0], a[k, 1], b[k, 0], b[k, 1]
        for t in range(scores.shape[0]):
            dx = x[t] + cos[t] * bx - sin[t] * by - ax
            dy = y[t] + sin[t] * bx + cos[t] * by - ay
            scores[t] += max(0.0, 1.0 - scale * (dx * dx + dy * dy))
    return scores


@njit
def _best(a: FloatArray, b: FloatArray, seeds: NDArray[np.int64]) -> tuple[FloatArray, NDArray[np.bool_]]:
    """Refine the best trials one after another and suppress trials near a hypothesis that was found before."""
    trials = _trials(a, b, seeds)
    scores = _scores(a, b, trials)
    poses = np.empty((MOST_HYPOTHESES, 3))
    agreeing = np.empty((MOST_HYPOTHESES, a.shape[0]), np.bool_)
    found = 0
    while found < MOST_HYPOTHESES and scores.shape[0]:
        best = np.argmax(scores)
        if scores[best] <= 0.0:
            break
        scores[best] = 0.0
        pose, agrees, count = _refine(a, b, _pose(trials, best))
        if count < LEAST_INLIERS:
            break  # the others have less support
        if _near(pose, poses[:found]):
            continue
        poses[found, 0], poses[found, 1], poses[found, 2] = pose
        assign(agreeing[found], agrees)
        found += 1
        for index in range(scores.shape[0]):
            if scores[index] > 0.0 and _near(_pose(trials, index), poses[found - 1 : found]):
                scores[index] = 0.0
    return poses[:found], agreeing[:found]


@njit(allocates=False)
def _pose(trials: FloatArray, index: int) -> se2.Pose:
    return trials[0, index], trials[1, index], np.arctan2(trials[3, index], trials[2, index])


@njit(allocates=False)
def _near(pose: se2.Pose, others: FloatArray) -> bool:
    """Whether a motion is not distinct from one of the ``others`` (N, 3)."""
    for index in range(others.shape[0]):
        dx, dy, turn = pose[0] - others[index, 0], pose[1] - others[index, 1], abs(pose[2] - others[index, 2])
        turn = min(turn, 2.0 * np.pi - turn)
        if dx * dx + dy * dy <= DISTINCT_M * DISTINCT_M and turn <= DISTINCT_RAD:
            return True
    return False


@njit
def _refine(a: FloatArray, b: FloatArray, pose: se2.Pose) -> tuple[se2.Pose, NDArray[np.bool_], int]:
    """Least squares over the inliers until these no longer change; returns the pose, its inliers and their number."""
    agrees, now = np.empty(a.shape[0], np.bool_), np.empty(a.shape[0], np.bool_)
    count = _agreeing(a, b, pose, agrees)
    for _ in range(_REFINEMENTS):
        refined = _least_squares(a, b, agrees)
        count_now = _agreeing(a, b, refined, now)
        if count_now < count:
            break
        unchanged = (now == agrees).all()
        pose, count = refined, count_now
        agrees, now = now, agrees
        if unchanged:
            break
    return pose, agrees, count


@njit(allocates=False)
def _agreeing(a: FloatArray, b: FloatArray, pose: se2.Pose, agrees: NDArray[np.bool_]) -> int:
    """Write which matches are inliers of a motion into ``agrees``; returns their number."""
    cos, sin = np.cos(pose[2]), np.sin(pose[2])
    count = 0
    for k in range(a.shape[0]):
        dx = pose[0] + cos * b[k, 0] - sin * b[k, 1] - a[k, 0]
        dy = pose[1] + sin * b[k, 0] + cos * b[k, 1] - a[k, 1]
        agrees[k] = dx * dx + dy * dy <= INLIER_M * INLIER_M
        count += agrees[k]
    return count


@njit(allocates=False)
def _least_squares(a: FloatArray, b: FloatArray, agrees: NDArray[np.bool_]) -> se2.Pose:
    """The rigid motion with the least squared distances, from the centred sums of products."""
    n = 0
    ax = ay = bx = by = dot = cross = 0.0
    for k in range(a.shape[0]):
        if agrees[k]:
            n += 1
            ax, ay, bx, by = ax + a[k, 0], ay + a[k, 1], bx + b[k, 0], by + b[k, 1]
    ax, ay, bx, by = ax / n, ay / n, bx / n, by / n
    for k in range(a.shape[0]):
        if agrees[k]:
            dot += (a[k, 0] - ax) * (b[k, 0] - bx) + (a[k, 1] - ay) * (b[k, 1] - by)
            cross += (b[k, 0] - bx) * (a[k, 1] - ay) - (b[k, 1] - by) * (a[k, 0] - ax)
    theta = np.arctan2(cross, dot)
    cos, sin = np.cos(theta), np.sin(theta)
    return ax - (cos * bx - sin * by), ay - (sin * bx + cos * by), theta


@dataclass(frozen=True, slots=True)
class Motion:
    """A possible relative pose of two places."""

    T_a_b: FloatArray
    """Shape (3,): x, y in metres and theta in radians; takes coordinates of place b to place a."""
    information: FloatArray
    """Information of (x, y, theta) in a's coordinates, shape (3, 3): constrains directions that the walls leave free.
    Zero for LiDAR places, whose keypoints are points on the same walls."""
    share: float
    """Matching descriptors divided by the descriptors of the smaller place, in [0, 1]."""


def propose_motions(a: Place, b: Place) -> list[Motion]:
    """Find the motions that enough matching keypoints support, the best first.

    Both places have descriptors of the same detector version.
    """
    matches = mutual_matches(a.descriptors, b.descriptors, LARGEST_HAMMING)
    if a.channel is Channel.CAMERA:
        matches = level_matches(a.keypoints, b.keypoints, matches)
    proposed = rigid_hypotheses(a.keypoints[:, :2], b.keypoints[:, :2], matches)
    share = len(matches.pairs) / max(1, min(len(a.descriptors), len(b.descriptors)))
    return [Motion(T_a_b, _information(b, T_a_b, matches.pairs[inliers, 1]), share) for T_a_b, inliers in proposed]


def level_matches(a: NDArray[np.floating], b: NDArray[np.floating], matches: Matches) -> Matches:
    """The matches of keypoints (N, 3) and (M, 3) that have the same height to within ``LARGEST_LEVEL_M``."""
    level = np.abs(a[matches.pairs[:, 0], 2] - b[matches.pairs[:, 1], 2]) <= LARGEST_LEVEL_M
    return Matches(matches.pairs[level], matches.distances[level])


def _information(b: Place, T_a_b: FloatArray, rows: NDArray[np.integer]) -> FloatArray:
    """Information of the motion from the positions of its inliers, ``rows`` of b (Gauss-Newton normal matrix)."""
    if b.channel is not Channel.CAMERA:
        return np.zeros((3, 3))
    inliers = b.keypoints[rows, :2].astype(np.float64)
    turned = se2.transform((0.0, 0.0, T_a_b[2]), inliers)
    jacobian = np.zeros((len(turned), 2, 3))
    jacobian[:, 0, 0] = jacobian[:, 1, 1] = 1.0
    jacobian[:, 0, 2], jacobian[:, 1, 2] = -turned[:, 1], turned[:, 0]
    total = np.einsum("kij,kil->jl", jacobian, jacobian)
    return np.asarray(total * min(1.0, INDEPENDENT_KEYPOINTS / len(inliers)) / KEYPOINT_SIGMA_M**2)
