"""Keyframe images that a robot keeps for itself, to describe them again when it gets another detector."""

from collections.abc import Iterator
from dataclasses import dataclass

from pydantic import Field

from fcslam.config import Settings
from fcslam.features.lidar_depth import LidarView
from fcslam.records import CameraModel, FloatArray


class ImageBufferConfig(Settings):
    """How much is kept, in memory; the oldest go first."""

    most_images: int = Field(default=500, ge=0, description="images that a new detector describes again; 0 for none")
    most_megabytes: float = Field(default=32.0, ge=0.0, description="and their size as they came from the camera [MB]")


@dataclass(frozen=True, slots=True)
class KeyframeImage:
    """A keyframe's image with all that places its keypoints."""

    keyscan: int
    encoded: bytes
    camera: CameraModel
    surroundings: LidarView
    """What the LiDAR saw, from the base at the moment of the image."""
    T_keyscan_image: FloatArray
    """Pose of the base at that moment, in the keyscan's."""


class ImageBuffer:
    """The newest shots, one a keyscan."""

    def __init__(self, config: ImageBufferConfig) -> None:
        self._config = config
        self._images: dict[int, KeyframeImage] = {}
        self._bytes = 0

    def __iter__(self) -> Iterator[KeyframeImage]:
        return iter(self._images.values())

    def add(self, shot: KeyframeImage) -> None:
        """Keep a shot of a keyscan that has none, and let go of the oldest where there is no room."""
        self._images[shot.keyscan] = shot
        self._bytes += len(shot.encoded)
        while len(self._images) > self._config.most_images or self._bytes > 1e6 * self._config.most_megabytes:
            oldest = self._images.pop(next(iter(self._images)))
            self._bytes -= len(oldest.encoded)
