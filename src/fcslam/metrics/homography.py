"""Measures of keypoints and matches between two images with a known homography.

H, shape (3, 3), maps pixel coordinates (x, y) of image 1 to image 2. It is scaled to H[2, 2] = 1, or is the plain
inverse of such a matrix, so the third homogeneous coordinate is positive in front of the image. Sizes are (width,
height) in pixels. The measures are those of SuperPoint (DeTone et al. 2018), of D2-Net (mean matching accuracy; Dusmanu
et al. 2019) and of KP2D (matching score; Tang et al. 2020).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from fcslam.records import FloatArray

Size = tuple[int, int]
"""Width and height in pixels."""

Mask = NDArray[np.bool_]
Rows = NDArray[np.int64]

CORRECT_PX = 3.0
"""Largest distance of a repeated keypoint."""


class HomographyGroundTruth(StrEnum):
    """How to compute the true homography between two scaled and cropped images."""

    CORRECTED = "corrected"
    """With the scale and the crop of both images: the correct one."""
    LEGACY = "legacy"
    """As in SuperPoint's widely used evaluation until 2019, which ignores the crop and the scale of the second image.
    Almost no match is then correct under a change of viewpoint, but published tables use it."""


@dataclass(frozen=True, slots=True)
class Framing:
    """Scaling with constant aspect ratio and cropping around the centre, to a given size."""

    scale: float
    crop_px: tuple[int, int]
    """Columns cut off at the left and rows cut off at the top, after scaling."""

    @classmethod
    def of(cls, image: Size, target: Size) -> "Framing":
        """Framing with the smallest scale at which the image covers the target."""
        scale = max(target[0] / image[0], target[1] / image[1])
        cut = [int(0.5 * (side * scale - wanted)) for side, wanted in zip(image, target, strict=True)]
        return cls(scale, (cut[0], cut[1]))

    @property
    def matrix(self) -> FloatArray:
        """Homography from pixels of the image to pixels of the framed image, shape (3, 3)."""
        return np.array([[self.scale, 0.0, -self.crop_px[0]], [0.0, self.scale, -self.crop_px[1]], [0.0, 0.0, 1.0]])


def framed_homography(H: FloatArray, first: Framing, second: Framing, truth: HomographyGroundTruth) -> FloatArray:
    """Homography (3, 3) between two framed images from H (3, 3) between the original images, in pixels."""
    if truth is HomographyGroundTruth.LEGACY:
        scaling = np.diag([first.scale, first.scale, 1.0])
        return scaling @ H @ np.linalg.inv(scaling)
    return second.matrix @ H @ np.linalg.inv(first.matrix)


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


def estimate_homography(first: FloatArray, second: FloatArray) -> FloatArray | None:
    """Estimate H (3, 3) from matched points (N, 2), pixels, by RANSAC with OpenCV's defaults (3 px, 2000 iterations).

    Returns None if there are fewer than 4 matches or no solution.
    """
    if len(first) < 4:
        return None
    H, _ = cv2.findHomography(first, second, cv2.RANSAC)
    return None if H is None or H[2, 2] == 0.0 else np.asarray(H, np.float64)


def corner_error(estimated: FloatArray | None, H: FloatArray, size: Size) -> float:
    """Mean distance, pixels, of the corners of image 1 mapped by both homographies (3, 3); infinite if undefined."""
    if estimated is None:
        return np.inf
    right, low = size[0] - 1.0, size[1] - 1.0
    corners = np.array([[0.0, 0.0], [right, 0.0], [0.0, low], [right, low]])
    error = float(np.mean(np.linalg.norm(warp(estimated, corners) - warp(H, corners), axis=1)))
    return error if np.isfinite(error) else np.inf


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


def matching_score(
    points: tuple[FloatArray, FloatArray], nearest: tuple[Rows, Rows], H: FloatArray, size: Size
) -> float:
    """Share of the keypoints in common view whose nearest neighbour is correct to 3 px, mean of both directions.

    ``nearest`` are the rows of each keypoint's nearest neighbour by descriptor in the other image, (N,) and (M,). H (3,
    3) takes image 1 to image 2.
    """
    first, second = points
    forward = _share_right(first, second[nearest[0]], H, size)
    backward = _share_right(second, first[nearest[1]], inverse(H), size)
    return 0.5 * (forward + backward)


def _share_right(points: FloatArray, neighbours: FloatArray, H: FloatArray, size: Size) -> float:
    seen = inside(warp(H, points), size)
    return float(np.mean(match_errors(points, neighbours, H)[seen] < 3.0)) if seen.any() else 0.0


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
