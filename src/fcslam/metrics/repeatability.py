"""Repeatability of a detector between two images with a known homography.

As in SuperPoint's evaluation (DeTone et al. 2018): the share of the strongest keypoints in common view that have a
keypoint of the other image within ``CORRECT_PX``.
"""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import KDTree

from fcslam.metrics.framing import Size
from fcslam.metrics.homography import Rows, inside, inverse, warp
from fcslam.records import FloatArray

CORRECT_PX = 3.0
"""Largest distance of a repeated keypoint."""


@dataclass(frozen=True, slots=True)
class Repeatability:
    """Repeatability of one pair of images, both directions together."""

    found: int
    """Repeated keypoints."""
    points: int
    """Keypoints in common view."""
    distance_px: float
    """Sum of the distances of repeated keypoints to their nearest neighbours."""

    @property
    def repeatability(self) -> float:
        """Share of the keypoints that are repeated; NaN without keypoints."""
        return self.found / self.points if self.points else float("nan")

    @property
    def localization_error_px(self) -> float:
        """Mean distance of repeated keypoints; NaN without any."""
        return self.distance_px / self.found if self.found else float("nan")


def repeatability(first: FloatArray, second: FloatArray, H: FloatArray, size: Size, most: int) -> Repeatability:
    """Compute the repeatability of keypoints, each set the strongest first.

    Args:
        first: keypoints of image 1, shape (N, 2), pixels.
        second: keypoints of image 2, shape (M, 2), pixels.
        H: homography (3, 3) from image 1 to image 2; distances are measured in image 2.
        size: width and height of both images, pixels.
        most: number of the strongest keypoints in common view that count in each image.
    """
    here = warp(H, first[in_common_view(first, H, size)][:most])
    there = second[in_common_view(second, inverse(H), size)][:most]
    points = len(here) + len(there)
    if not (len(here) and len(there)):
        return Repeatability(0, points, 0.0)
    distances = np.concatenate((KDTree(there).query(here)[0], KDTree(here).query(there)[0]))
    found = distances <= CORRECT_PX
    return Repeatability(int(found.sum()), points, float(distances[found].sum()))


def in_common_view(points: FloatArray, H: FloatArray, size: Size) -> Rows:
    """Rows (K,) of the ``points`` (N, 2), pixels, that H (3, 3) maps into the other image, ascending."""
    return np.flatnonzero(inside(warp(H, points), size))
