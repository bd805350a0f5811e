"""Two images of one plane: where points of one are in the other, and how well matches tell it.

H takes pixel coordinates (x, y) of image 1 to image 2, and is scaled to H[2, 2] = 1, or is the plain inverse of such a
matrix: then the third coordinate of what it maps is positive in front of the image. Sizes are (width, height). The
measures are those of SuperPoint (DeTone et al. 2018), of D2-Net (mean matching accuracy; Dusmanu et al. 2019) and of
KP2D (matching score; Tang et al. 2020).
"""

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from fcslam.metrics.framing import Size
from fcslam.records import FloatArray

Mask = NDArray[np.bool_]
Rows = NDArray[np.int64]


def warp(H: FloatArray, points: FloatArray) -> FloatArray:
    """Where ``points`` (N, 2) are in the other image; NaN for those behind it."""
    mapped = np.column_stack((points, np.ones(len(points)))) @ H.T
    depth = np.where(mapped[:, 2] > 0.0, mapped[:, 2], np.nan)
    return mapped[:, :2] / depth[:, None]


def inverse(H: FloatArray) -> FloatArray:
    """H from image 2 to image 1."""
    return np.asarray(np.linalg.inv(H), np.float64)


def inside(points: FloatArray, size: Size) -> Mask:
    """Which of ``points`` (N, 2) lie in an image of that size, shape (N,)."""
    lies: Mask = np.all((points >= 0.0) & (points < size), axis=1)
    return lies


def estimate_homography(first: FloatArray, second: FloatArray) -> FloatArray | None:
    """H from matched points (N, 2) by RANSAC with OpenCV's defaults (3 px, 2000 iterations); None if there is none."""
    if len(first) < 4:
        return None
    H, _ = cv2.findHomography(first, second, cv2.RANSAC)
    return None if H is None or H[2, 2] == 0.0 else np.asarray(H, np.float64)


def corner_error(estimated: FloatArray | None, H: FloatArray, size: Size) -> float:
    """Mean distance in pixels between where both put the corners of image 1; infinite where that is nowhere."""
    if estimated is None:
        return np.inf
    right, low = size[0] - 1.0, size[1] - 1.0
    corners = np.array([[0.0, 0.0], [right, 0.0], [0.0, low], [right, low]])
    error = float(np.mean(np.linalg.norm(warp(estimated, corners) - warp(H, corners), axis=1)))
    return error if np.isfinite(error) else np.inf


def match_errors(first: FloatArray, second: FloatArray, H: FloatArray) -> FloatArray:
    """How far each point of image 1, taken to image 2, lies from its match, shape (N,); infinite behind the image."""
    errors = np.linalg.norm(warp(H, first) - second, axis=1)
    return np.where(np.isnan(errors), np.inf, errors)


def matching_accuracy(errors: FloatArray, thresholds_px: Sequence[float]) -> FloatArray:
    """Share of the matches with at most so much error, one for each threshold; 0 without matches."""
    if not len(errors):
        return np.zeros(len(thresholds_px))
    return np.array([np.mean(errors <= threshold) for threshold in thresholds_px])


def matching_score(
    points: tuple[FloatArray, FloatArray], nearest: tuple[Rows, Rows], H: FloatArray, size: Size
) -> float:
    """Share of the keypoints in common view whose nearest neighbour is right to 3 px, mean of both directions.

    Args:
        points: keypoints of image 1, (N, 2), and of image 2, (M, 2).
        nearest: for each of them the row of its nearest neighbour by descriptor among all of the other image.
        H: from image 1 to image 2.
        size: of both images.
    """
    first, second = points
    forward = _share_right(first, second[nearest[0]], H, size)
    backward = _share_right(second, first[nearest[1]], inverse(H), size)
    return 0.5 * (forward + backward)


def _share_right(points: FloatArray, neighbours: FloatArray, H: FloatArray, size: Size) -> float:
    seen = inside(warp(H, points), size)
    return float(np.mean(match_errors(points, neighbours, H)[seen] < 3.0)) if seen.any() else 0.0
