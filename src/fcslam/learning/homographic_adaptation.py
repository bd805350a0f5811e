"""Homographic adaptation (DeTone et al. 2018): a detector's answer averaged over many warped copies of an image.

What is found again from other viewpoints adds up; what was chance fades. Any detector will do that gives a response at
every pixel: the network itself, or Harris's measure, which on planes is found again best of all.
"""

from collections.abc import Callable
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from fcslam.features.detector import GreyImage
from fcslam.learning.warps import Crop, inverse, random_change, warp
from fcslam.records import FloatArray

Response = NDArray[np.float32]
"""Shape (height, width): how much of a keypoint is at each pixel."""

HARRIS_BLOCK_PX: Final = 4
HARRIS_K: Final = 0.04
BORDER_PX: Final = 4
"""Nothing is a keypoint so close to the rim."""


def adapt(
    detector: Callable[[GreyImage], Response], image: GreyImage, copies: int, rng: np.random.Generator
) -> Response:
    """Mean response of ``detector`` over the image itself and ``copies`` warped ones, where these see it."""
    height, width = image.shape
    crop = Crop(width, height)
    total = detector(image).astype(np.float32)
    count = np.ones(image.shape, np.float32)
    for _ in range(copies):
        homography = random_change(crop, rng)
        back = inverse(homography)
        response = detector(warp(image, homography, crop))
        everywhere = np.zeros(image.shape, np.float32)
        everywhere[BORDER_PX:-BORDER_PX, BORDER_PX:-BORDER_PX] = 1.0
        total += _unwarp(response * everywhere, back)
        count += _unwarp(everywhere, back)
    return total / count


def harris(image: GreyImage) -> Response:
    """Harris's corner measure (Harris and Stephens 1988); its root, so that strong contrast does not drown the rest."""
    measure = np.asarray(cv2.cornerHarris(image, HARRIS_BLOCK_PX, 3, HARRIS_K), np.float32)
    response: Response = np.sqrt(np.maximum(measure, np.float32(0.0)))
    return response


def peaks(response: Response, radius_px: int, most: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """The strongest local maxima, to a fraction of a pixel.

    Returns:
        Shape (N, 2), x and y in pixels, and shape (N,), the response there; strongest first.
    """
    around = cv2.dilate(response, np.ones((2 * radius_px + 1, 2 * radius_px + 1), np.uint8))
    found = (response >= around) & (response > 0.0)
    found[:BORDER_PX], found[-BORDER_PX:], found[:, :BORDER_PX], found[:, -BORDER_PX:] = False, False, False, False
    rows, columns = np.nonzero(found)
    order = np.argsort(-response[rows, columns], kind="stable")[:most]
    rows, columns = rows[order], columns[order]
    points = np.stack((columns, rows), axis=1) + _vertices(response, rows, columns)
    return points.astype(np.float32), response[rows, columns]


def _vertices(response: Response, rows: NDArray[np.int64], columns: NDArray[np.int64]) -> FloatArray:
    """Offsets (N, 2) of the tops of the parabolas through a maximum and its neighbours, at most half a pixel."""
    middle = response[rows, columns]
    offsets = []
    for left, right in (
        (response[rows, columns - 1], response[rows, columns + 1]),
        (response[rows - 1, columns], response[rows + 1, columns]),
    ):
        bend = left - 2.0 * middle + right
        offsets.append(np.where(bend < 0.0, 0.5 * (left - right) / np.where(bend < 0.0, bend, 1.0), 0.0))
    clipped: FloatArray = np.clip(np.stack(offsets, axis=1), -0.5, 0.5)
    return clipped


def _unwarp(response: Response, homography: FloatArray) -> Response:
    height, width = response.shape
    return np.asarray(cv2.warpPerspective(response, homography, (width, height), flags=cv2.INTER_LINEAR), np.float32)
