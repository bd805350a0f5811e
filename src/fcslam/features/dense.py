"""From what a network says of every pixel and every cell to keypoints and 256-bit codes.

The contract of a network's output: keypoint probabilities for every pixel, and logits of the code's bits for cells of
``CELL_PX`` pixels, whose centres lie at pixel ``CELL_PX * index + (CELL_PX - 1) / 2``. Logits are interpolated before
they become bits, bit = 1 where the logit is not negative (FC-SLAM, eq. (1)).
"""

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from fcslam.features.nms import box_nms
from fcslam.records import Codes

CELL_PX = 8

Probabilities = NDArray[np.float32]
"""Shape (height, width), in [0, 1]."""
Logits = NDArray[np.float32]
"""Shape (bits, rows, columns)."""


def find_peaks(
    scores: Probabilities, least_score: float, nms_px: float, most: int
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Local maxima, the strongest first: positions (K, 2) in pixels, finer than a pixel, and their scores (K,).

    Args:
        scores: keypoint probabilities.
        least_score: what is not above this is no keypoint.
        nms_px: side of the boxes that may hardly overlap (``nms.box_nms``).
        most: K at most.
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
    """Codes at ``positions_px`` (K, 2), shape (K, bits / 8): the first bit is the highest of the first byte."""
    bits: NDArray[np.bool_] = sample_logits(logits, positions_px) >= 0.0
    return np.packbits(bits, axis=1)


def sample_logits(logits: Logits, positions_px: NDArray[np.float32]) -> NDArray[np.float32]:
    """Logits interpolated bilinearly at ``positions_px`` (K, 2), beyond the outer centres the nearest: (K, bits)."""
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


@njit(cache=True)
def _interpolate(
    cells: NDArray[np.float32], corners: NDArray[np.int64], u: NDArray[np.float32], v: NDArray[np.float32]
) -> NDArray[np.float32]:
    """Between the cells (C, bits) at four corners (K, 4), u (K,) of the way to the right, v (K,) downwards."""
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
    """From each peak's pixel to the top of the parabolas through it and its neighbours in x and y, shape (K, 2)."""
    padded = np.pad(scores, 1, mode="edge")
    x, y = pixels[:, 0] + 1, pixels[:, 1] + 1
    middle = padded[y, x]
    offsets = np.zeros(pixels.shape, np.float32)
    sides = ((padded[y, x - 1], padded[y, x + 1]), (padded[y - 1, x], padded[y + 1, x]))
    for axis, (before, behind) in enumerate(sides):
        bend = 2.0 * middle - before - behind
        slope = 0.5 * (behind - before)
        offsets[:, axis] = np.divide(slope, bend, out=np.zeros_like(slope), where=bend > 0.0)
    # beside the image's edge a neighbour is missing, so nothing is known about the top there
    height, width = scores.shape
    offsets[(pixels[:, 0] == 0) | (pixels[:, 0] == width - 1), 0] = 0.0
    offsets[(pixels[:, 1] == 0) | (pixels[:, 1] == height - 1), 1] = 0.0
    return offsets
