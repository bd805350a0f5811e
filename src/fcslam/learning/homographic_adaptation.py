"""Homographic adaptation (DeTone et al. 2018): averages a detector's response over many warped copies of an image.

Points that are found from many viewpoints keep a strong response, chance detections do not. It works with any detector
that gives a response at every pixel: the network itself, or Harris's measure, the most repeatable one on planes.
"""

from collections.abc import Callable

import cv2
import numpy as np
from numpy.typing import NDArray

from fcslam.features.dense import find_peaks
from fcslam.features.detector import GreyImage
from fcslam.learning.homography import BORDER_PX, inverse
from fcslam.learning.labels import Points
from fcslam.learning.warps import random_change, warp_image
from fcslam.records import FloatArray

Response = NDArray[np.float32]
"""Shape (height, width): strength of a keypoint at each pixel."""


def adapt(
    detector: Callable[[GreyImage], Response], image: GreyImage, copies: int, rng: np.random.Generator
) -> Response:
    """Mean response of ``detector`` over the image and ``copies`` warped copies that show a pixel."""
    size = (image.shape[1], image.shape[0])
    total = detector(image).astype(np.float32)
    count = np.ones(image.shape, np.float32)
    for _ in range(copies):
        homography = random_change(size, rng)
        back = inverse(homography)
        response = detector(warp_image(image, homography, size))
        everywhere = np.zeros(image.shape, np.float32)
        everywhere[BORDER_PX:-BORDER_PX, BORDER_PX:-BORDER_PX] = 1.0
        total += _unwarp(response * everywhere, back)
        count += _unwarp(everywhere, back)
    return total / count


def harris(image: GreyImage) -> Response:
    """Square root of Harris's corner measure (Harris and Stephens 1988); the root limits strong contrast."""
    measure = np.asarray(cv2.cornerHarris(image, blockSize=4, ksize=3, k=0.04), np.float32)
    response: Response = np.sqrt(np.maximum(measure, np.float32(0.0)))
    return response


def peaks(response: Response, nms_px: float, most: int) -> Points:
    """The strongest local maxima, shape (N, 2) [px] with sub-pixel accuracy, strongest first."""
    within = np.zeros_like(response)
    inner = (slice(BORDER_PX, -BORDER_PX),) * 2
    within[inner] = response[inner]
    points, _ = find_peaks(within, 0.0, nms_px, most)
    return points


def _unwarp(response: Response, homography: FloatArray) -> Response:
    height, width = response.shape
    return np.asarray(cv2.warpPerspective(response, homography, (width, height), flags=cv2.INTER_LINEAR), np.float32)
