"""OpenCV's ORB, and the choice between it and the network: its descriptors are binary too."""

from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from fcslam.features.detector import (
    NO_FEATURES,
    FeatureDetector,
    GreyImage,
    ImageFeatures,
    Keypoints,
    OnnxConfig,
    OnnxDetector,
)
from fcslam.features.detector_kinds import DetectorKind
from fcslam.records import FloatArray, frozen

ORB_VERSION = "orb-1"
"""Changes whenever the same image would give other descriptors."""


class Orb:
    """Oriented FAST corners with rotated BRIEF codes (Rublee et al. 2011)."""

    def __init__(self, most_features: int = 300, fast_threshold: int = 7) -> None:
        """``fast_threshold``: smallest contrast of a FAST corner, in grey levels of 255; low for dim light."""
        self._orb = cv2.ORB.create(nfeatures=most_features, fastThreshold=fast_threshold)

    @property
    def version(self) -> str:
        """As in ``FeatureDetector``."""
        return ORB_VERSION

    def detect(self, image: GreyImage) -> ImageFeatures:
        """Features of an image (H, W), ranked by the Harris response."""
        keypoints, descriptors = self._orb.detectAndCompute(image, None)
        if descriptors is None:
            return NO_FEATURES
        positions, responses = positions_and_responses(keypoints)
        # OpenCV multiplies positions by the scale of the level, which shifts pixel centres by half the difference.
        scales = self._orb.getScaleFactor() ** np.array([keypoint.octave for keypoint in keypoints])
        found, order = ranked(positions + 0.5 * (scales[:, None] - 1.0), responses)
        return ImageFeatures(found.keypoints_px, found.scores, frozen(descriptors[order], np.uint8))


def positions_and_responses(keypoints: Sequence[Any]) -> tuple[FloatArray, FloatArray]:
    """Positions (K, 2) in pixels and responses (K,) of OpenCV's keypoints."""
    positions = np.array([keypoint.pt for keypoint in keypoints], np.float64).reshape(-1, 2)
    return positions, np.array([keypoint.response for keypoint in keypoints], np.float64)


def ranked(positions: FloatArray, responses: FloatArray) -> tuple[Keypoints, NDArray[np.int64]]:
    """Keypoints by descending response, and their rows in the input, shape (K,)."""
    order = np.argsort(-responses, kind="stable")
    return Keypoints(frozen(positions[order], np.float32), frozen(responses[order], np.float32)), order


def make_detector(kind: DetectorKind, onnx: OnnxConfig) -> FeatureDetector:
    """Make a detector of the given kind; ORB takes the number of features alone from the settings."""
    return OnnxDetector(onnx) if kind is DetectorKind.ONNX else Orb(onnx.most_features)
