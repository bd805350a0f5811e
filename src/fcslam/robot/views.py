"""Keyframe images: what the camera shows of a place, as descriptors with metric positions. The images stay here."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from fcslam.config import Settings
from fcslam.features.classical import OrbConfig
from fcslam.features.detector import GreyImage, OnnxConfig, decode_grey
from fcslam.features.detector_file import open_detector_file
from fcslam.features.detector_kinds import DetectorKind
from fcslam.features.factory import make_detector
from fcslam.features.lidar_depth import LidarView, locate_keypoints
from fcslam.geometry import se2
from fcslam.lidar.mapper import ScanPose
from fcslam.lidar.scan import point_scan
from fcslam.records import CameraImage, Codes, DetectorFile, FloatArray, LaserScan, frozen
from fcslam.robot.image_buffer import ImageBuffer, ImageBufferConfig, KeyframeImage


class ViewsConfig(Settings):
    """Which images become places, and what is kept of them."""

    every_m: float = Field(default=1.0, gt=0.0, description="travel between two camera places [m]")
    every_rad: float = Field(default=0.5, gt=0.0, description="or turn: half of what a camera sees is new [rad]")
    fewest_keypoints: int = Field(default=20, ge=1, description="an image of a bare wall is no place")
    ceiling_m: float = Field(default=3.0, gt=0.0, description="keypoints above this lie on no wall [m]")
    detector: DetectorKind = Field(default=DetectorKind.ONNX, description="what describes images: a network or orb")
    orb: OrbConfig = Field(default=OrbConfig(), description="settings of detector orb")
    onnx: OnnxConfig = Field(default=OnnxConfig(), description="settings of detector onnx")
    image_buffer: ImageBufferConfig = Field(default=ImageBufferConfig(), description="images kept for another detector")


@dataclass(frozen=True, slots=True)
class CameraView:
    """One keyframe image, as far as it leaves the robot."""

    keyscan: int
    keypoints: NDArray[np.float32]
    """Shape (K, 3): x, y, z in metres in the keyscan's base."""
    descriptors: Codes
    """Shape (K, 32)."""
    detector_version: str


class ViewExtractor:
    """Picks images that show something new and turns them into views."""

    def __init__(self, config: ViewsConfig) -> None:
        """Load the detector.

        Raises:
            FeatureError: it is a network whose weights cannot be used.
        """
        self._config = config
        self._detector = make_detector(config.detector, config.orb, config.onnx)
        self._image_buffer = ImageBuffer(config.image_buffer)
        self._scan: LaserScan | None = None
        self._pose: ScanPose | None = None
        self._last: tuple[int, FloatArray] | None = None
        """Keyscan and odometry of the last view."""

    @property
    def detector_version(self) -> str:
        """Of the descriptors."""
        return self._detector.version

    def set_scan(self, scan: LaserScan, pose: ScanPose) -> None:
        """The robot has seen this scan from this pose."""
        self._scan, self._pose = scan, pose

    def describe(self, image: CameraImage) -> CameraView | None:
        """The view in the next image; None if it shows little, or little that is new.

        Between the last scan and the image the robot moved as its odometry says, or not at all if that is not known.
        """
        if self._scan is None or self._pose is None:
            return None
        odometry = self._scan.T_odom_base if image.T_odom_base is None else image.T_odom_base
        if not self._is_new(self._pose.keyscan, odometry):
            return None
        picture = decode_grey(image.encoded)
        if picture is None or picture.shape != (image.camera.height, image.camera.width):
            return None
        self._last = self._pose.keyscan, odometry
        T_scan_image = se2.between(self._scan.T_odom_base, odometry)
        returns = point_scan(self._scan.ranges_m, self._scan.laser)
        spacing_rad = abs(self._scan.laser.angle_increment_rad)
        ends = se2.transform(se2.inverse(T_scan_image), np.vstack((returns.origin, returns.points)))
        T_keyscan_image = se2.compose(self._pose.T_keyscan_base, T_scan_image)
        surroundings = LidarView(ends[1:], ends[0], spacing_rad)
        shot = KeyframeImage(self._pose.keyscan, image.encoded, image.camera, surroundings, T_keyscan_image)
        view = self._describe(shot, picture)
        if view is not None:
            self._image_buffer.add(shot)
        return view

    def set_detector(self, file: DetectorFile, path: Path) -> None:
        """Look with a network that was announced and fetched from now on.

        Raises:
            FeatureError: it is another file, or cannot be used; nothing has changed.
        """
        self._detector = open_detector_file(file, path, self._config.onnx)

    def reset(self) -> None:
        """What was seen is of a session that has ended."""
        self._image_buffer = ImageBuffer(self._config.image_buffer)
        self._scan = self._pose = self._last = None

    def describe_again(self) -> list[CameraView]:
        """The views in the images that are still here, oldest first, as the detector sees them now."""
        pictures = ((shot, decode_grey(shot.encoded)) for shot in self._image_buffer)
        views = (self._describe(shot, picture) for shot, picture in pictures if picture is not None)
        return [view for view in views if view is not None]

    def _describe(self, shot: KeyframeImage, picture: GreyImage) -> CameraView | None:
        features = self._detector.detect(picture)
        positions, placed = locate_keypoints(
            features.keypoints_px, shot.camera, shot.surroundings, self._config.ceiling_m
        )
        if placed.sum() < self._config.fewest_keypoints:
            return None
        positions[:, :2] = se2.transform(shot.T_keyscan_image, positions[:, :2])
        keypoints, codes = frozen(positions[placed], np.float32), frozen(features.descriptors[placed], np.uint8)
        return CameraView(shot.keyscan, keypoints, codes, self._detector.version)

    def _is_new(self, keyscan: int, T_odom_base: FloatArray) -> bool:
        """A keyscan has one view at most, which names its place."""
        if self._last is None:
            return True
        seen_from, T_odom_last = self._last
        motion = se2.between(T_odom_last, T_odom_base)
        moved = np.hypot(motion[0], motion[1]) >= self._config.every_m or abs(motion[2]) >= self._config.every_rad
        return bool(moved) and keyscan > seen_from
