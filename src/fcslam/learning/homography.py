"""Homographies between images, and measures of keypoints and matches under a known one.

H, shape (3, 3), maps pixel coordinates (x, y) of image 1 to image 2. It is scaled to H[2, 2] = 1, or is the plain
inverse of such a matrix, so the third homogeneous coordinate is positive in front of the image. Sizes are (width,
height) in pixels. The measures are those of SuperPoint (DeTone et al. 2018) and of D2-Net (Dusmanu et al. 2019).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from fcslam.records import FloatArray

Size = tuple[int, int]
"""Width and height in pixels."""

Mask = NDArray[np.bool_]
Rows = NDArray[np.int64]

CORRECT_PX = 3.0
"""Largest distance of a repeated keypoint, and of two detectors' keypoints that are the same point."""
BORDER_PX = 4
"""Points closer to the border of an image than this are not used."""


def warp(H: FloatArray, points: FloatArray) -> FloatArray:
    """Map ``points`` (N, 2), pixels, to the other image by H (3, 3): shape (N, 2), NaN for points behind the image."""
    mapped = np.column_stack((points, np.ones(len(points)))) @ H.T
    depth = np.where(mapped[:, 2] > 0.0, mapped[:, 2], np.nan)
    return mapped[:, :2] / depth[:, None]


def inverse(H: FloatArray) -> FloatArray:
    """Homography (3, 3) from image 2 to image 1."""
    return np.asarray(np.linalg.inv(H), np.float64)


def inside(points: FloatArray, size: Size) -> Mask:
    """Whether ``points`` (N, 2), pixels, lie in an image of that size, shape (N,)."""
    lies: Mask = np.all((points >= 0.0) & (points < size), axis=1)
    return lies


def match_errors(first: FloatArray, second: FloatArray, H: FloatArray) -> FloatArray:
    """Distance of each point ``first`` (N, 2), mapped by H (3, 3), to its match ``second`` (N, 2), pixels, shape (N,).

    Infinite for points behind the image.
    """
    errors = np.linalg.norm(warp(H, first) - second, axis=1)
    return np.where(np.isnan(errors), np.inf, errors)


def matching_accuracy(errors: FloatArray, thresholds_px: Sequence[float]) -> FloatArray:
    """Share of the matches with ``errors`` (N,) of at most each threshold (T,), shape (T,); 0 without matches."""
    if not len(errors):
        return np.zeros(len(thresholds_px))
    return np.array([np.mean(errors <= threshold) for threshold in thresholds_px])


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

    Keypoints (N, 2) and (M, 2) in pixels; H (3, 3) takes image 1 to image 2, in which distances are measured. The
    ``most`` strongest keypoints in common view count in each image.
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
