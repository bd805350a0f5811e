"""Camera views: descriptors of keyframe images with metric positions. The images stay on the robot."""

from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

import numpy as np
from pydantic import Field

from fcslam.config import Settings
from fcslam.features.classical import make_detector
from fcslam.features.detector import FeatureDetector, GreyImage, MissingExtraError, OnnxConfig, decode_grey
from fcslam.features.detector_file import open_detector_file
from fcslam.features.detector_kinds import DetectorKind
from fcslam.features.lidar_depth import LidarView, locate_among
from fcslam.geometry import se2
from fcslam.lidar.first_motion import LONGEST_GAP_S
from fcslam.lidar.frontend import ScanPose
from fcslam.lidar.scan import point_scan
from fcslam.records import CameraImage, Channel, DetectorFile, FloatArray, KeyscanId, LaserScan, Place, frozen
from fcslam.robot.keyframe_folder import KeyframeFolder, KeyframeImage

EVERY_M, EVERY_RAD = 1.0, 0.5
"""Travel or turn after which an image becomes a camera place; after the turn, about half of the view is new."""
FEWEST_KEYPOINTS = 20
"""Least number of keypoints with a position; an image with fewer is not a place."""
MOST_IMAGES, MOST_BYTES = 500, 32_000_000
"""Size of the buffer of images: their number, and the bytes of all encoded images together."""


class ViewsConfig(Settings):
    """How images are described."""

    detector: DetectorKind = Field(
        default=DetectorKind.ONNX, description="detector of camera images: onnx (a network) or orb"
    )
    weights: Path | None = Field(
        default=None,
        description="ONNX file with the weights of the network; null: the bundled network; vgg: the paper's, also "
        "bundled",
    )


class ViewExtractor:
    """Picks images that show something new and describes them as places of their keyscans alone.

    It keeps the newest of them in a buffer. The images stay on the robot; places are what leaves it.
    """

    def __init__(self, robot: str, config: ViewsConfig, folder: KeyframeFolder | None = None) -> None:
        """Load the detector, if its library is installed. ``folder`` keeps the keyframes of the image buffer."""
        self._robot, self._config = robot, config
        self._detector: FeatureDetector | None = None
        with suppress(MissingExtraError):  # then the first image says so, as a robot may have a LiDAR alone
            self._detector = self._make_detector()
        self._images: dict[int, KeyframeImage] = {}
        """The image buffer, by keyscan, oldest first."""
        self._folder = folder
        self._last: tuple[int, FloatArray] | None = None
        """Keyscan and odometry of the last view."""

    @property
    def detector_version(self) -> str | None:
        """Version of the detector; None if its library is not installed."""
        return None if self._detector is None else self._detector.version

    def _make_detector(self) -> FeatureDetector:
        return make_detector(self._config.detector, OnnxConfig(weights=self._config.weights))

    def describe(self, image: CameraImage, scan: LaserScan, pose: ScanPose, scans: Sequence[LaserScan]) -> Place | None:
        """Describe the next image.

        ``scan`` is the newest one before it, and ``scans`` are the newest of each laser. The motion between the scan
        and the image is that of the odometry, or zero if the image has none. None if the image has too few keypoints,
        cannot be decoded, or shows little that is new.
        """
        odometry = scan.T_odom_base if image.T_odom_base is None else image.T_odom_base
        if not self._is_new(pose.keyscan, odometry):
            return None
        picture = decode_grey(image.encoded)
        if picture is None or picture.shape != (image.camera.height, image.camera.width):
            return None
        self._last = pose.keyscan, odometry
        T_scan_image = se2.between(scan.T_odom_base, odometry)
        T_keyscan_image = se2.compose(pose.T_keyscan_base, T_scan_image)
        surroundings = tuple(
            _lidar_view(other, odometry) for other in scans if abs(scan.stamp - other.stamp) <= LONGEST_GAP_S
        )
        keyframe = KeyframeImage(pose.keyscan, image.encoded, image.camera, surroundings, T_keyscan_image)
        view = self._describe(keyframe, picture)
        if view is not None:
            self._images[pose.keyscan] = keyframe
            self._drop_oldest()
        return view

    @property
    def keyframes(self) -> tuple[KeyframeImage, ...]:
        """The buffered images of the present session, oldest first."""
        return tuple(self._images.values())

    def set_detector(self, file: DetectorFile, path: Path) -> None:
        """Use a downloaded network from now on."""
        self._detector = open_detector_file(file, path)

    def reset(self) -> None:
        """Start a new session: forget all images."""
        self._images = {}
        self._last = None

    def describe_again(self) -> list[Place]:
        """Describe all buffered images with the present detector, oldest first."""
        pictures = ((image, decode_grey(image.encoded)) for image in self._images.values())
        views = (self._describe(image, picture) for image, picture in pictures if picture is not None)
        return [view for view in views if view is not None]

    def _describe(self, image: KeyframeImage, picture: GreyImage) -> Place | None:
        self._detector = detector = self._detector or self._make_detector()
        features = detector.detect(picture)
        positions, placed = locate_among(features.keypoints_px, image.camera, image.surroundings)
        if placed.sum() < FEWEST_KEYPOINTS:
            return None
        if self._folder is not None:
            self._folder.keep(image, features, detector.version)
        positions[:, :2] = se2.transform(image.T_keyscan_image, positions[:, :2])
        keypoints, codes = frozen(positions[placed], np.float32), frozen(features.descriptors[placed], np.uint8)
        number = image.keyscan
        return Place(KeyscanId(self._robot, number), Channel.CAMERA, detector.version, number, number, keypoints, codes)

    def _drop_oldest(self) -> None:
        for keyscan in list(self._images)[: surplus([len(image.encoded) for image in self._images.values()])]:
            del self._images[keyscan]
            if self._folder is not None:
                self._folder.drop(keyscan)

    def _is_new(self, keyscan: int, T_odom_base: FloatArray) -> bool:
        if self._last is None:
            return True
        seen_from, T_odom_last = self._last
        motion = se2.between(T_odom_last, T_odom_base)
        moved = np.hypot(motion[0], motion[1]) >= EVERY_M or abs(motion[2]) >= EVERY_RAD
        return bool(moved) and keyscan > seen_from


def surplus(sizes: Sequence[int]) -> int:
    """How many of the oldest images, of these sizes in bytes, the buffer has no room for."""
    newest_bytes = np.cumsum(sizes[::-1])
    return len(sizes) - min(MOST_IMAGES, int(np.searchsorted(newest_bytes, MOST_BYTES, side="right")))


def _lidar_view(scan: LaserScan, T_odom_image: FloatArray) -> LidarView:
    """A scan as seen from the robot's pose at an image, shape (3,), by odometry."""
    returns = point_scan(scan.ranges_m, scan.laser, scan.sweep)
    T_image_scan = se2.inverse(se2.between(scan.T_odom_base, T_odom_image))
    ends = se2.transform(T_image_scan, np.vstack((returns.origin, returns.points)))
    return LidarView(ends[1:], ends[0], abs(scan.laser.angle_increment_rad))
