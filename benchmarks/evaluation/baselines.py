"""Detectors that the evaluation compares with.

FAST, Harris and Shi-Tomasi only detect. SIFT has descriptors of 128 floats, the logits of a network are 256 floats.
"""

from dataclasses import dataclass
from typing import Final, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from fcslam.features.classical import positions_and_responses, ranked
from fcslam.features.dense import box_nms
from fcslam.features.detector import GreyImage, Keypoints, OnnxDetector
from fcslam.records import FloatArray, frozen

_CORNERS: Final = 600
"""Most corners of an image, as in the evaluation of SuperPoint (DeTone et al. 2018)."""
_NMS_PX: Final = 4.0
"""Distance of non-maximum suppression of corners."""
_WINDOW_PX = 5
"""Half the side of the window in which a keypoint is moved to a corner, less half a pixel."""
_FAST_THRESHOLD: Final = 10
"""OpenCV's default for FAST corners [grey levels of 255]."""
_SIFT_NUMBERS: Final = 128
"""Dimension of a SIFT descriptor."""


@dataclass(frozen=True, slots=True)
class FloatFeatures(Keypoints):
    """Keypoints with float descriptors, compared by Euclidean distance."""

    descriptors: NDArray[np.float32]
    """Shape (K, D)."""


class KeypointDetector(Protocol):
    """Finds keypoints."""

    def detect(self, image: GreyImage) -> Keypoints:
        """Keypoints of an image (H, W), the strongest first; K = 0 without any."""


def logit_features(network: OnnxDetector, image: GreyImage) -> FloatFeatures:
    """The keypoints of a network in an image (H, W), with their logits, scaled to unit length, as descriptors.

    A comparison with ``detect`` measures the loss by quantisation to bits.
    """
    found, logits = network.find(image)
    lengths = np.maximum(np.linalg.norm(logits, axis=1, keepdims=True), np.finfo(np.float32).tiny)
    return FloatFeatures(found.keypoints_px, found.scores, frozen(logits / lengths, np.float32))


class Sift:
    """SIFT: difference-of-Gaussians blobs with gradient histograms (Lowe 2004)."""

    def __init__(self, most_features: int) -> None:
        self._sift = cv2.SIFT.create(nfeatures=most_features)

    def detect(self, image: GreyImage) -> FloatFeatures:
        """Features of an image (H, W), ranked by contrast."""
        keypoints, descriptors = self._sift.detectAndCompute(image, None)
        if descriptors is None:
            descriptors = np.empty((0, _SIFT_NUMBERS))
        found, order = ranked(*positions_and_responses(keypoints))
        return FloatFeatures(found.keypoints_px, found.scores, frozen(descriptors[order], np.float32))


class Fast:
    """FAST corners (segment test, Rosten and Drummond 2006)."""

    def __init__(self) -> None:
        self._fast = cv2.FastFeatureDetector.create(_FAST_THRESHOLD)

    def detect(self, image: GreyImage) -> Keypoints:
        """Corners of an image (H, W), the strongest first."""
        return _strongest(*positions_and_responses(self._fast.detect(image)))


class Harris:
    """Harris corners (Harris and Stephens 1988): every pixel with a positive response, then non-maximum suppression."""

    def detect(self, image: GreyImage) -> Keypoints:
        """Corners of an image (H, W), the strongest first."""
        response = cv2.cornerHarris(image.astype(np.float32) / np.float32(255.0), blockSize=4, ksize=3, k=0.04)
        rows, columns = np.nonzero(response > 0.0)
        return _strongest(np.column_stack((columns, rows)), response[rows, columns])


class ShiTomasi:
    """Shi-Tomasi corners, "good features to track" (Shi and Tomasi 1994)."""

    def detect(self, image: GreyImage) -> Keypoints:
        """Corners of an image (H, W), the strongest first."""
        corners, qualities = cv2.goodFeaturesToTrackWithQuality(image, _CORNERS, 1e-4, 5, None)
        if corners is None:
            return _strongest(np.empty((0, 2)), np.empty(0))
        return _strongest(corners.reshape(-1, 2), qualities.ravel())


def _strongest(positions: FloatArray, responses: FloatArray) -> Keypoints:
    corners, _ = ranked(positions, responses)
    return corners.take(box_nms(corners.keypoints_px, _NMS_PX)[:_CORNERS])


def moved_to_corners(image: GreyImage, positions_px: NDArray[np.float32]) -> NDArray[np.float32]:
    """Positions (K, 2) at the nearest corner of an image, where one is within a few pixels (Foerstner's operator)."""
    if not len(positions_px):
        return positions_px
    limits = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 30, 0.01)
    start = np.array(positions_px, np.float32, order="C").reshape(-1, 1, 2)
    moved = cv2.cornerSubPix(image, start, (_WINDOW_PX, _WINDOW_PX), (-1, -1), limits)
    return np.asarray(moved[:, 0], np.float32)
