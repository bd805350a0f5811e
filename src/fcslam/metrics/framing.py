"""Scaling and cropping of images to a common size, and the homography between the resulting images."""

from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from fcslam.records import FloatArray

Size = tuple[int, int]
"""Width and height in pixels."""


class HomographyGroundTruth(StrEnum):
    """How to compute the true homography between two scaled and cropped images."""

    CORRECTED = "corrected"
    """With the scale and the crop of both images: the correct one."""
    LEGACY = "legacy"
    """As in SuperPoint's widely used evaluation until 2019, which ignores the crop and the scale of the second image.
    Almost no match is then correct under a change of viewpoint, but published tables use it."""


@dataclass(frozen=True, slots=True)
class Framing:
    """Scaling with constant aspect ratio and cropping around the centre, to a given size."""

    scale: float
    crop_px: tuple[int, int]
    """Columns cut off at the left and rows cut off at the top, after scaling."""

    @classmethod
    def of(cls, image: Size, target: Size) -> "Framing":
        """Framing with the smallest scale at which the image covers the target."""
        scale = max(target[0] / image[0], target[1] / image[1])
        cut = [int(0.5 * (side * scale - wanted)) for side, wanted in zip(image, target, strict=True)]
        return cls(scale, (cut[0], cut[1]))

    @property
    def matrix(self) -> FloatArray:
        """Homography from pixels of the image to pixels of the framed image, shape (3, 3)."""
        return np.array([[self.scale, 0.0, -self.crop_px[0]], [0.0, self.scale, -self.crop_px[1]], [0.0, 0.0, 1.0]])


def framed_homography(H: FloatArray, first: Framing, second: Framing, truth: HomographyGroundTruth) -> FloatArray:
    """Homography (3, 3) between two framed images from H (3, 3) between the original images, in pixels."""
    if truth is HomographyGroundTruth.LEGACY:
        scaling = np.diag([first.scale, first.scale, 1.0])
        return scaling @ H @ np.linalg.inv(scaling)
    return second.matrix @ H @ np.linalg.inv(first.matrix)
