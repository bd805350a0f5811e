"""Planar motions between two places from their matching keypoints, each with its information matrix.

LiDAR keypoints are points in the plane. Keypoints of images also have a height. Robots drive on one floor, so matching
keypoints must have the same height, and the motion is planar as well.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np

from fcslam.features.codes import Matches, mutual_matches
from fcslam.geometry import se2
from fcslam.places.hypotheses import Hypothesis, rigid_hypotheses
from fcslam.records import Channel, FloatArray, Place

INDEPENDENT_KEYPOINTS: Final = 10
"""Most independent keypoints of one image. The errors of its keypoints are correlated, because they share one scan and
one robot pose, so more keypoints do not add information."""
LARGEST_HAMMING = 60
"""Largest Hamming distance of two matching descriptors, bits."""
LEAST_INLIERS = 8
"""Fewest inliers of a motion that the submaps then verify."""
LARGEST_LEVEL_M = 0.1
"""Largest difference in height of two matching image keypoints, metres."""
KEYPOINT_SIGMA_M = 0.1
"""Standard deviation of the position of an image keypoint, metres."""


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

    Args:
        a, b: two places with descriptors of the same detector version.
    """
    matches = mutual_matches(a.descriptors, b.descriptors, LARGEST_HAMMING)
    if a.channel is Channel.CAMERA:
        matches = _level(a, b, matches)
    proposed = rigid_hypotheses(a.keypoints[:, :2], b.keypoints[:, :2], matches)
    share = len(matches.pairs) / max(1, min(len(a.descriptors), len(b.descriptors)))
    return [Motion(h.T_a_b, _information(b, h, matches), share) for h in proposed if h.inlier_count >= LEAST_INLIERS]


def _level(a: Place, b: Place, matches: Matches) -> Matches:
    """Keep the matches whose keypoints have the same height to within ``LARGEST_LEVEL_M``."""
    heights_a, heights_b = a.keypoints[matches.pairs[:, 0], 2], b.keypoints[matches.pairs[:, 1], 2]
    level = np.abs(heights_a - heights_b) <= LARGEST_LEVEL_M
    return Matches(matches.pairs[level], matches.distances[level])


def _information(b: Place, hypothesis: Hypothesis, matches: Matches) -> FloatArray:
    """Information of the motion from the positions of its inliers (Gauss-Newton normal matrix)."""
    if b.channel is not Channel.CAMERA:
        return np.zeros((3, 3))
    inliers = b.keypoints[matches.pairs[hypothesis.inliers, 1], :2].astype(np.float64)
    turned = se2.transform((0.0, 0.0, hypothesis.T_a_b[2]), inliers)
    jacobian = np.zeros((len(turned), 2, 3))
    jacobian[:, 0, 0] = jacobian[:, 1, 1] = 1.0
    jacobian[:, 0, 2], jacobian[:, 1, 2] = -turned[:, 1], turned[:, 0]
    total = np.einsum("kij,kil->jl", jacobian, jacobian)
    return np.asarray(total * min(1.0, INDEPENDENT_KEYPOINTS / len(inliers)) / KEYPOINT_SIGMA_M**2)
