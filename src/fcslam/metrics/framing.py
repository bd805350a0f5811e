"""Images of one size for every detector, and what that makes of the homography between them."""

from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from fcslam.records import FloatArray

Size = tuple[int, int]
"""Width and height in pixels."""


class HomographyGroundTruth(StrEnum):
    """Which homography counts as true between two scaled and cropped images."""

    CORRECTED = "corrected"
    """The right one."""
    LEGACY = "legacy"
    """As in SuperPoint's widely used evaluation until 2019: the crop and the second image's scale are forgotten, so
    almost nothing holds under a change of viewpoint. Published tables rest on it."""


@dataclass(frozen=True, slots=True)
class Framing:
    """How an image was brought to a size: scaled, keeping its proportions, and cropped around its middle."""

    scale: float
    crop_px: tuple[int, int]
    """Columns cut off at the left and rows cut off at the top, after scaling."""

    @classmethod
    def of(cls, image: Size, target: Size) -> "Framing":
        """The smallest scale at which the image covers the target."""
        scale = max(target[0] / image[0], target[1] / image[1])
        cut = [int(0.5 * (side * scale - wanted)) for side, wanted in zip(image, target, strict=True)]
        return cls(scale, (cut[0], cut[1]))

    @property
    def matrix(self) -> FloatArray:
        """Takes pixels of the image to pixels of the framed one, shape (3, 3)."""
        return np.array([[self.scale, 0.0, -self.crop_px[0]], [0.0, self.scale, -self.crop_px[1]], [0.0, 0.0, 1.0]])


def framed_homography(H: FloatArray, first: Framing, second: Framing, truth: HomographyGroundTruth) -> FloatArray:
    """H between the framed images, shape (3, 3)."""
    if truth is HomographyGroundTruth.LEGACY:
        scaling = np.diag([first.scale, first.scale, 1.0])
        return scaling @ H @ np.linalg.inv(scaling)
    return second.matrix @ H @ np.linalg.inv(first.matrix)
