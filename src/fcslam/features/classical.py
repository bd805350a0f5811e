"""Classical detectors from OpenCV, and the choice between ORB and the network.

ORB has binary descriptors and can replace the network on a robot. The others are baselines of the evaluation: FAST,
Harris and Shi-Tomasi only detect, SIFT has descriptors of 128 floats.
"""

from collections.abc import Sequence
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from fcslam.config import Settings
from fcslam.features.detector import (
    NO_FEATURES,
    FeatureDetector,
    FloatFeatures,
    GreyImage,
    ImageFeatures,
    Keypoints,
    OnnxConfig,
    OnnxDetector,
)
from fcslam.features.detector_kinds import DetectorKind
from fcslam.features.nms import box_nms
from fcslam.records import FloatArray, frozen

ORB_VERSION = "orb-1"
"""Changes whenever the same image would give other descriptors."""

_CORNERS: Final = 600
"""Most corners of an image, as in the evaluation of SuperPoint (DeTone et al. 2018)."""
_NMS_PX: Final = 4.0
"""Distance of non-maximum suppression of corners."""
_FAST_THRESHOLD: Final = 10
"""OpenCV's default for FAST corners [grey levels of 255]."""
_SIFT_NUMBERS: Final = 128
"""Dimension of a SIFT descriptor."""
_PYRAMID_STEP: Final = 1.2
"""Scale factor between two levels of ORB's pyramid, OpenCV's default."""
PYRAMID_LEVELS = 8
"""Levels of ORB's image pyramid, each 1.2 times coarser than the one before."""


class OrbConfig(Settings):
    """The ORB detector. Places from different settings cannot be compared."""

    most_features: int = Field(
        default=300, ge=1, le=2000, description="most ORB features of an image, the strongest first"
    )
    fast_threshold: int = Field(
        default=7,
        ge=1,
        le=100,
        description="smallest contrast of a FAST corner, low for dim light [grey levels of 255]",
    )


class Orb:
    """Oriented FAST corners with rotated BRIEF codes (Rublee et al. 2011)."""

    def __init__(self, config: OrbConfig) -> None:
        self._orb = cv2.ORB.create(
            nfeatures=config.most_features,
            scaleFactor=_PYRAMID_STEP,
            nlevels=PYRAMID_LEVELS,
            fastThreshold=config.fast_threshold,
        )

    @property
    def version(self) -> str:
        """As in ``FeatureDetector``."""
        return ORB_VERSION

    def detect(self, image: GreyImage) -> ImageFeatures:
        """Features of an image (H, W), ranked by the Harris response."""
        keypoints, descriptors = self._orb.detectAndCompute(image, None)
        if descriptors is None:
            return NO_FEATURES
        positions, responses = _positions_and_responses(keypoints)
        # OpenCV multiplies positions by the scale of the level, which shifts pixel centres by half the difference.
        scales = _PYRAMID_STEP ** np.array([keypoint.octave for keypoint in keypoints])
        found, order = _ranked(positions + 0.5 * (scales[:, None] - 1.0), responses)
        return ImageFeatures(found.keypoints_px, found.scores, frozen(descriptors[order], np.uint8))


class Sift:
    """SIFT: difference-of-Gaussians blobs with gradient histograms (Lowe 2004)."""

    def __init__(self, most_features: int) -> None:
        self._sift = cv2.SIFT.create(nfeatures=most_features)

    def detect(self, image: GreyImage) -> FloatFeatures:
        """Features of an image (H, W), ranked by contrast."""
        keypoints, descriptors = self._sift.detectAndCompute(image, None)
        if descriptors is None:
            descriptors = np.empty((0, _SIFT_NUMBERS))
        found, order = _ranked(*_positions_and_responses(keypoints))
        return FloatFeatures(found.keypoints_px, found.scores, frozen(descriptors[order], np.float32))


class Fast:
    """FAST corners (segment test, Rosten and Drummond 2006)."""

    def __init__(self) -> None:
        self._fast = cv2.FastFeatureDetector.create(_FAST_THRESHOLD)

    def detect(self, image: GreyImage) -> Keypoints:
        """Corners of an image (H, W), the strongest first."""
        return _strongest(*_positions_and_responses(self._fast.detect(image)))


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


def _positions_and_responses(keypoints: Sequence[Any]) -> tuple[FloatArray, FloatArray]:
    """Positions (K, 2) in pixels and responses (K,) of OpenCV's keypoints."""
    positions = np.array([keypoint.pt for keypoint in keypoints], np.float64).reshape(-1, 2)
    return positions, np.array([keypoint.response for keypoint in keypoints], np.float64)


def _ranked(positions: FloatArray, responses: FloatArray) -> tuple[Keypoints, NDArray[np.int64]]:
    """Keypoints by descending response, and their rows in the input, shape (K,)."""
    order = np.argsort(-responses, kind="stable")
    return Keypoints(frozen(positions[order], np.float32), frozen(responses[order], np.float32)), order


def _strongest(positions: FloatArray, responses: FloatArray) -> Keypoints:
    corners, _ = _ranked(positions, responses)
    return corners.take(box_nms(corners.keypoints_px, _NMS_PX)[:_CORNERS])


def make_detector(kind: DetectorKind, orb: OrbConfig, onnx: OnnxConfig) -> FeatureDetector:
    """Make a detector of the given kind; only its own settings are used.

    Raises:
        FeatureError: the weights of the network cannot be used.
    """
    return OnnxDetector(onnx) if kind is DetectorKind.ONNX else Orb(orb)
