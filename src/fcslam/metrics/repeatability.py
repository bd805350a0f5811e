"""Repeatability of a detector: whether what it finds in one image of a plane it finds in another as well.

As in SuperPoint's evaluation (DeTone et al. 2018): of the points that both images show the strongest, found again if
the other image has one within ``CORRECT_PX``.
"""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import KDTree

from fcslam.metrics.framing import Size
from fcslam.metrics.homography import Rows, inside, inverse, warp
from fcslam.records import FloatArray

CORRECT_PX = 3.0


@dataclass(frozen=True, slots=True)
class Repeatability:
    """Of one pair of images, both directions together."""

    found: int
    """Points that have one of the other image's near them."""
    points: int
    distance_px: float
    """Sum over the points found of the distance to the nearest."""

    @property
    def repeatability(self) -> float:
        """Share of the points that are found again; NaN without points."""
        return self.found / self.points if self.points else float("nan")

    @property
    def localisation_error_px(self) -> float:
        """Mean distance of the points found to the nearest; NaN without any."""
        return self.distance_px / self.found if self.found else float("nan")


def repeatability(first: FloatArray, second: FloatArray, H: FloatArray, size: Size, most: int) -> Repeatability:
    """Repeatability of keypoints of image 1, (N, 2), and of image 2, (M, 2), each the strongest first.

    Args:
        first: in pixels of image 1.
        second: in pixels of image 2.
        H: from image 1 to image 2; distances count in image 2.
        size: width and height of both images.
        most: the strongest points of each image that count, of those which the other image shows, too.
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
    """Rows of those ``points`` (N, 2) that the other image shows, ascending; H takes them there."""
    return np.flatnonzero(inside(warp(H, points), size))
