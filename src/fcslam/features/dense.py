"""From a network's dense output to keypoints and 256-bit codes.

The output is a keypoint probability for every pixel, and logits of the code's bits for cells of ``CELL_PX`` pixels. The
centre of a cell is at pixel ``CELL_PX * index + (CELL_PX - 1) / 2``. Logits are interpolated first and thresholded
then: a bit is 1 if the logit is not negative (FC-SLAM, eq. (1)). Non-maximum suppression is by boxes around keypoints,
as in SuperPoint's evaluation.
"""

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from fcslam.compiled import njit
from fcslam.records import Codes

MOST_OVERLAP = 0.1
"""Largest intersection over union of two boxes. With integer pixels and boxes of side 4, keypoints 4 px apart along an
axis stay, and so do keypoints 3 px apart along one axis and 2 px along the other."""
CELL_PX = 8
"""Side of a cell of logits in pixels, as in SuperPoint."""

Probabilities = NDArray[np.float32]
"""Shape (height, width), in [0, 1]."""
Logits = NDArray[np.float32]
"""Shape (bits, rows, columns)."""


def find_peaks(
    scores: Probabilities, least_score: float, nms_px: float, most: int
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Local maxima of keypoint probabilities (H, W) above ``least_score``, at most ``most``, the strongest first.

    ``nms_px`` is the side of the boxes of non-maximum suppression. Returns positions (K, 2) to a part of a pixel, x and
    y, and scores (K,).
    """
    if not scores.size:
        return np.empty((0, 2), np.float32), np.empty(0, np.float32)
    highest = cv2.dilate(scores, np.ones((3, 3), np.uint8))
    rows, columns = np.nonzero((scores == highest) & (scores > least_score))
    strengths = scores[rows, columns]
    order = np.argsort(-strengths, kind="stable")
    pixels = np.column_stack((columns, rows))[order]
    kept = box_nms(pixels, nms_px)[:most]
    pixels = pixels[kept]
    return (pixels + _offsets(scores, pixels)).astype(np.float32), strengths[order][kept]


def sample_codes(logits: Logits, positions_px: NDArray[np.float32]) -> Codes:
    """Sample codes at ``positions_px`` (K, 2): shape (K, bits / 8), the first bit is the highest of the first byte."""
    bits: NDArray[np.bool_] = sample_logits(logits, positions_px) >= 0.0
    return np.packbits(bits, axis=1)


def sample_logits(logits: Logits, positions_px: NDArray[np.float32]) -> NDArray[np.float32]:
    """Sample logits (bits, rows, columns) bilinearly at ``positions_px`` (K, 2), clamped at the border: (K, bits)."""
    bits, rows, columns = logits.shape
    cells = np.asarray(cv2.transpose(np.ascontiguousarray(logits).reshape(bits, -1)), np.float32)
    place = (positions_px.astype(np.float64) - 0.5 * (CELL_PX - 1)) / CELL_PX
    x, y = np.clip(place[:, 0], 0, columns - 1), np.clip(place[:, 1], 0, rows - 1)
    left, top = np.floor(x).astype(np.int64), np.floor(y).astype(np.int64)
    right, bottom = np.minimum(left + 1, columns - 1), np.minimum(top + 1, rows - 1)
    corners = np.column_stack([row * columns + column for row in (top, bottom) for column in (left, right)])
    u, v = (x - left).astype(np.float32), (y - top).astype(np.float32)
    sampled: NDArray[np.float32] = _interpolate(cells, corners, u, v)
    return sampled


@njit
def _interpolate(
    cells: NDArray[np.float32], corners: NDArray[np.int64], u: NDArray[np.float32], v: NDArray[np.float32]
) -> NDArray[np.float32]:
    """Bilinear interpolation of the cells (C, bits) at four corners (K, 4) with weights u (K,) in x and v (K,) in y."""
    sampled = np.empty((len(corners), cells.shape[1]), np.float32)
    one = np.float32(1.0)
    for k in range(len(corners)):
        upper_left, upper_right, lower_left, lower_right = corners[k]
        for bit in range(cells.shape[1]):
            upper = (one - u[k]) * cells[upper_left, bit] + u[k] * cells[upper_right, bit]
            lower = (one - u[k]) * cells[lower_left, bit] + u[k] * cells[lower_right, bit]
            sampled[k, bit] = (one - v[k]) * upper + v[k] * lower
    return sampled


def _offsets(scores: Probabilities, pixels: NDArray[np.int64]) -> NDArray[np.float32]:
    """Subpixel offsets of peaks, shape (K, 2): vertices of the parabolas through each peak and its neighbours."""
    padded = np.pad(scores, 1, mode="edge")
    x, y = pixels[:, 0] + 1, pixels[:, 1] + 1
    middle = padded[y, x]
    offsets = np.zeros(pixels.shape, np.float32)
    sides = ((padded[y, x - 1], padded[y, x + 1]), (padded[y - 1, x], padded[y + 1, x]))
    for axis, (before, behind) in enumerate(sides):
        bend = 2.0 * middle - before - behind
        slope = 0.5 * (behind - before)
        offsets[:, axis] = np.divide(slope, bend, out=np.zeros_like(slope), where=bend > 0.0)
    # at the image's border a neighbour is missing, so there is no parabola
    height, width = scores.shape
    offsets[(pixels[:, 0] == 0) | (pixels[:, 0] == width - 1), 0] = 0.0
    offsets[(pixels[:, 1] == 0) | (pixels[:, 1] == height - 1), 1] = 0.0
    return offsets


def box_nms(positions_px: ArrayLike, side_px: float) -> NDArray[np.int64]:
    """Rows (K,), ascending, of the keypoints that no box of a stronger one overlaps by more than ``MOST_OVERLAP``.

    ``positions_px`` (N, 2) are finite, the strongest first. Suppressed keypoints suppress none; side 0 keeps all.
    """
    points = np.asarray(positions_px, np.float64).reshape(-1, 2)
    if side_px <= 0.0 or not len(points):
        return np.arange(len(points))
    cells = np.floor((points - points.min(axis=0)) / side_px).astype(np.int64)
    rows: NDArray[np.int64] = np.flatnonzero(_keep(points, cells, float(side_px)))
    return rows


@njit
def _keep(points: NDArray[np.float64], cells: NDArray[np.int64], side: float) -> NDArray[np.bool_]:
    """Mask of the remaining keypoints. Only boxes in neighbouring cells can overlap; each cell chains its keypoints."""
    columns, rows = cells[:, 0].max() + 3, cells[:, 1].max() + 3
    newest = np.full((rows, columns), -1)
    before = np.full(len(points), -1)
    kept = np.zeros(len(points), np.bool_)
    for i in range(len(points)):
        column, row = cells[i, 0] + 1, cells[i, 1] + 1
        free = True
        for v in range(row - 1, row + 2):
            for u in range(column - 1, column + 2):
                j = newest[v, u]
                while free and j >= 0:
                    width = side - abs(points[i, 0] - points[j, 0])
                    height = side - abs(points[i, 1] - points[j, 1])
                    if width > 0.0 and height > 0.0:
                        common = width * height
                        free = common <= MOST_OVERLAP * (2.0 * side * side - common)
                    j = before[j]
        if free:
            kept[i] = True
            before[i], newest[row, column] = newest[row, column], i
    return kept
