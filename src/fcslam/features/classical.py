"""Detectors without learning: ORB (Rublee et al. 2011)."""

import cv2
import numpy as np
from pydantic import Field

from fcslam.config import Settings
from fcslam.features.detector import NO_FEATURES, GreyImage, ImageFeatures
from fcslam.records import frozen

ORB_VERSION = "orb-1"
"""Changes whenever the same image would give other descriptors."""


_PYRAMID_STEP = 1.2


class OrbConfig(Settings):
    """ORB. A change makes old and new places incomparable."""

    most_features: int = Field(default=300, ge=1, le=2000, description="features kept of an image, strongest first")
    fast_threshold: int = Field(default=7, ge=1, le=100, description="least contrast of a corner; low for dim light")
    pyramid_levels: int = Field(default=8, ge=1, le=16, description="scales, each 1.2 times coarser than the last")


class Orb:
    """Oriented FAST corners with rotated BRIEF codes, from OpenCV."""

    def __init__(self, config: OrbConfig) -> None:
        self._orb = cv2.ORB.create(
            nfeatures=config.most_features,
            scaleFactor=_PYRAMID_STEP,
            nlevels=config.pyramid_levels,
            fastThreshold=config.fast_threshold,
        )

    @property
    def version(self) -> str:
        """As in ``Detector``."""
        return ORB_VERSION

    def detect(self, image: GreyImage) -> ImageFeatures:
        """Features of an image, its corners ranked by Harris's measure."""
        keypoints, descriptors = self._orb.detectAndCompute(image, None)
        if descriptors is None:
            return NO_FEATURES
        scores = np.array([keypoint.response for keypoint in keypoints])
        order = np.argsort(-scores, kind="stable")
        positions = np.array([keypoint.pt for keypoint in keypoints])
        # OpenCV multiplies by the scale of the level; the centre of a coarse pixel lies half of the difference further.
        scales = _PYRAMID_STEP ** np.array([keypoint.octave for keypoint in keypoints])
        positions += 0.5 * (scales[:, None] - 1.0)
        return ImageFeatures(
            frozen(positions[order], np.float32),
            frozen(scores[order], np.float32),
            frozen(descriptors[order], np.uint8),
        )
