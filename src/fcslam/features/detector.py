"""What a detector of keypoints in camera images gives, whichever it is: ORB today, a network tomorrow."""

from dataclasses import dataclass
from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from fcslam.records import CODE_BYTES, Codes, frozen

GreyImage = NDArray[np.uint8]
"""Shape (height, width)."""


@dataclass(frozen=True, slots=True)
class ImageFeatures:
    """Features of one image, the strongest first."""

    keypoints_px: NDArray[np.float32]
    """Shape (K, 2): x to the right, y down; (0, 0) is the centre of the first pixel."""
    scores: NDArray[np.float32]
    """Shape (K,), on the detector's own scale."""
    descriptors: Codes
    """Shape (K, 32)."""


NO_FEATURES = ImageFeatures(
    frozen(np.empty((0, 2)), np.float32), frozen(np.empty(0), np.float32), frozen(np.empty((0, CODE_BYTES)), np.uint8)
)


class Detector(Protocol):
    """Finds keypoints and describes each by 256 bits."""

    @property
    def version(self) -> str:
        """Changes whenever the same image would give other descriptors; words of different ones are not compared."""

    def detect(self, image: GreyImage) -> ImageFeatures:
        """Features of an image; none where there is nothing to see."""


def decode_grey(encoded: bytes) -> GreyImage | None:
    """The picture in a JPEG or PNG file in grey levels, as its pixels are stored; None if it is broken."""
    try:
        decoded = cv2.imdecode(np.frombuffer(encoded, np.uint8), cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION)
    except cv2.error:  # of no bytes at all, for one
        return None
    return None if decoded is None else np.asarray(decoded, np.uint8)
