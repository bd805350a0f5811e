"""Buffer of keyframe images on the robot, so that a new detector can describe them again."""

from collections.abc import Iterator
from dataclasses import dataclass

from fcslam.features.lidar_depth import LidarView
from fcslam.records import CameraModel, FloatArray

MOST_IMAGES, MOST_BYTES = 500, 32_000_000
"""Size of the buffer, which is in memory: images, and bytes of all encoded images together."""


@dataclass(frozen=True, slots=True)
class KeyframeImage:
    """An encoded image with all that is needed to find the positions of its keypoints."""

    keyscan: int
    encoded: bytes
    camera: CameraModel
    surroundings: tuple[LidarView, ...]
    """LiDAR returns of each laser in the base at the time of the image."""
    T_keyscan_image: FloatArray
    """Pose of the base at the time of the image in the keyscan's base, shape (3,), metres and radians."""


class ImageBuffer:
    """The newest images, one a keyscan."""

    def __init__(self) -> None:
        self._images: dict[int, KeyframeImage] = {}
        self._bytes = 0

    def __iter__(self) -> Iterator[KeyframeImage]:
        return iter(self._images.values())

    def add(self, image: KeyframeImage) -> list[int]:
        """Add the image of a keyscan that has none; drop the oldest images if the buffer is full, and return the
        keyscans of these."""
        self._images[image.keyscan] = image
        dropped = []
        self._bytes += len(image.encoded)
        while len(self._images) > MOST_IMAGES or self._bytes > MOST_BYTES:
            oldest = self._images.pop(next(iter(self._images)))
            self._bytes -= len(oldest.encoded)
            dropped.append(oldest.keyscan)
        return dropped
