"""Detectors without learning, from OpenCV.

ORB describes by bits and can take a network's place on a robot. The others are there to be compared with: FAST, Harris
and Shi-Tomasi find corners, SIFT describes by 128 numbers.
"""

from collections.abc import Sequence
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from fcslam.config import Settings
from fcslam.features.detector import NO_FEATURES, FloatFeatures, GreyImage, ImageFeatures, Keypoints
from fcslam.features.nms import box_nms
from fcslam.records import FloatArray, frozen

ORB_VERSION = "orb-1"
"""Changes whenever the same image would give other descriptors."""

_CORNERS: Final = 600
"""Corners kept of an image, as in the evaluation of SuperPoint."""
_SIFT_NUMBERS: Final = 128
_PYRAMID_STEP: Final = 1.2
"""Of ORB, from one scale to the next."""


class OrbConfig(Settings):
    """ORB. A change makes old and new places incomparable."""

    most_features: int = Field(default=300, ge=1, le=2000, description="features kept of an image, strongest first")
    fast_threshold: int = Field(default=7, ge=1, le=100, description="least contrast of a corner; low for dim light")
    pyramid_levels: int = Field(default=8, ge=1, le=16, description="scales, each 1.2 times coarser than the last")


class Orb:
    """Oriented FAST corners with rotated BRIEF codes (Rublee et al. 2011)."""

    def __init__(self, config: OrbConfig) -> None:
        self._orb = cv2.ORB.create(
            nfeatures=config.most_features,
            scaleFactor=_PYRAMID_STEP,
            nlevels=config.pyramid_levels,
            fastThreshold=config.fast_threshold,
        )

    @property
    def version(self) -> str:
        """As in ``FeatureDetector``."""
        return ORB_VERSION

    def detect(self, image: GreyImage) -> ImageFeatures:
        """Features of an image, its corners ranked by Harris's measure."""
        keypoints, descriptors = self._orb.detectAndCompute(image, None)
        if descriptors is None:
            return NO_FEATURES
        positions, responses = _positions_and_responses(keypoints)
        # OpenCV multiplies by the scale of the level; the centre of a coarse pixel lies half of the difference further.
        scales = _PYRAMID_STEP ** np.array([keypoint.octave for keypoint in keypoints])
        found, order = _ranked(positions + 0.5 * (scales[:, None] - 1.0), responses)
        return ImageFeatures(found.keypoints_px, found.scores, frozen(descriptors[order], np.uint8))


class Sift:
    """Blobs of the difference of Gaussians with histograms of gradients (Lowe 2004)."""

    def __init__(self, most_features: int) -> None:
        self._sift = cv2.SIFT.create(nfeatures=most_features)

    def detect(self, image: GreyImage) -> FloatFeatures:
        """Features of an image, ranked by contrast."""
        keypoints, descriptors = self._sift.detectAndCompute(image, None)
        if descriptors is None:
            descriptors = np.empty((0, _SIFT_NUMBERS))
        found, order = _ranked(*_positions_and_responses(keypoints))
        return FloatFeatures(found.keypoints_px, found.scores, frozen(descriptors[order], np.float32))


class Fast:
    """Corners by the segment test (Rosten and Drummond 2006)."""

    def __init__(self, threshold: int = 10, nms_px: float = 4.0) -> None:
        self._fast = cv2.FastFeatureDetector.create(threshold)
        self._nms_px = nms_px

    def detect(self, image: GreyImage) -> Keypoints:
        """Corners of an image."""
        return _strongest(*_positions_and_responses(self._fast.detect(image)), self._nms_px)


class Harris:
    """Corners by Harris and Stephens (1988): every pixel with a positive response, thinned out."""

    def __init__(self, nms_px: float = 4.0) -> None:
        self._nms_px = nms_px

    def detect(self, image: GreyImage) -> Keypoints:
        """Corners of an image."""
        response = cv2.cornerHarris(image.astype(np.float32) / np.float32(255.0), blockSize=4, ksize=3, k=0.04)
        rows, columns = np.nonzero(response > 0.0)
        return _strongest(np.column_stack((columns, rows)), response[rows, columns], self._nms_px)


class ShiTomasi:
    """Good features to track (Shi and Tomasi 1994)."""

    def __init__(self, nms_px: float = 4.0) -> None:
        self._nms_px = nms_px

    def detect(self, image: GreyImage) -> Keypoints:
        """Corners of an image."""
        corners, qualities = cv2.goodFeaturesToTrackWithQuality(image, _CORNERS, 1e-4, 5, None)
        if corners is None:
            return _strongest(np.empty((0, 2)), np.empty(0), self._nms_px)
        return _strongest(corners.reshape(-1, 2), qualities.ravel(), self._nms_px)


def _positions_and_responses(keypoints: Sequence[Any]) -> tuple[FloatArray, FloatArray]:
    """Of OpenCV's keypoints: shapes (K, 2) and (K,)."""
    positions = np.array([keypoint.pt for keypoint in keypoints], np.float64).reshape(-1, 2)
    return positions, np.array([keypoint.response for keypoint in keypoints], np.float64)


def _ranked(positions: FloatArray, responses: FloatArray) -> tuple[Keypoints, NDArray[np.int64]]:
    """The strongest first, and which rows they were."""
    order = np.argsort(-responses, kind="stable")
    return Keypoints(frozen(positions[order], np.float32), frozen(responses[order], np.float32)), order


def _strongest(positions: FloatArray, responses: FloatArray, nms_px: float) -> Keypoints:
    corners, _ = _ranked(positions, responses)
    return corners.take(box_nms(corners.keypoints_px, nms_px)[:_CORNERS])
