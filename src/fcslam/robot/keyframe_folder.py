"""Keyframes of the camera on the robot's own disk, for the process that learns beside it. They never leave the robot.

There is one file for each keyframe, and one for each session with the poses of its keyscans.
"""

import logging
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Final

import numpy as np

from fcslam.errors import InputError
from fcslam.features.detector import ImageFeatures
from fcslam.features.lidar_depth import LidarView
from fcslam.geometry import se2
from fcslam.records import CameraModel, FloatArray, Transform, frozen
from fcslam.storage.state_file import State, read_state, write_state

KEYFRAMES: Final = "keyframes"
"""Folder of the keyframes, below a robot's state folder."""
FITS: Final = "fcslam keyframes 1"
_POSES, _SUFFIX = "poses", ".state"
_log = logging.getLogger(__name__)


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


@dataclass(frozen=True, slots=True, eq=False)
class KeptKeyframe:
    """A keyframe as the process beside the robot reads it."""

    session: int
    """Session of this start, from 0."""
    image: KeyframeImage
    features: ImageFeatures
    detector_version: str
    T_own_base: FloatArray
    """Estimated pose at the image in the robot's own map, shape (3,), metres and radians."""


class KeyframeFolder:
    """Writes the keyframes of one start of a robot."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._is_failed = False
        self.session = 0
        """Session whose keyframes are written."""
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InputError(f"{folder}: cannot keep keyframes ({error}); give another --state") from error

    def keep(self, image: KeyframeImage, features: ImageFeatures, detector_version: str) -> None:
        """Write a keyframe, or the one of this keyscan again with a newer detector."""
        state: State = {
            "encoded": np.frombuffer(image.encoded, np.uint8),
            "camera": {**asdict(image.camera), "T_base_camera": np.concatenate(image.camera.T_base_camera)},
            "surroundings": {
                str(number): {"returns": view.returns, "origin": view.origin, "spacing_rad": float(view.spacing_rad)}
                for number, view in enumerate(image.surroundings)
            },
            "T_keyscan_image": image.T_keyscan_image,
            "keypoints_px": features.keypoints_px,
            "scores": features.scores,
            "descriptors": features.descriptors,
            "detector_version": detector_version,
        }
        self._write(self._path(image.keyscan), state)

    def drop(self, keyscan: int) -> None:
        """Remove a keyframe of this session."""
        self._path(keyscan).unlink(missing_ok=True)

    def place(self, T_own_keyscan: FloatArray) -> None:
        """Write the poses of all keyscans of this session in the robot's own map, shape (N, 3)."""
        self._write(self._folder / f"{self.session}-{_POSES}{_SUFFIX}", {"T_own_keyscan": T_own_keyscan})

    def _path(self, keyscan: int) -> Path:
        return self._folder / f"{self.session}-{keyscan}{_SUFFIX}"

    def _write(self, path: Path, state: State) -> None:
        """Mapping goes on without the keyframes of a full disk."""
        if self._is_failed:
            return
        try:
            write_state(path, FITS, state)
        except OSError as error:
            self._is_failed = True
            _log.warning("%s: no keyframe is kept from now on (%s)", self._folder, error)


def read_keyframes(folder: Path, most: int) -> list[KeptKeyframe]:
    """The ``most`` newest keyframes whose poses are known, by session and keyscan; a damaged file is left out."""
    numbers = sorted(
        tuple(map(int, path.stem.split("-"))) for path in folder.glob(f"*{_SUFFIX}") if not path.stem.endswith(_POSES)
    )
    poses: dict[int, FloatArray] = {}
    for session in {session for session, _ in numbers}:
        state = _read(folder / f"{session}-{_POSES}{_SUFFIX}")
        poses[session] = np.empty((0, 3)) if state is None else state["T_own_keyscan"]
    known = [(session, keyscan) for session, keyscan in numbers if keyscan < len(poses[session])]
    found = ((session, poses[session][keyscan], keyscan) for session, keyscan in known[-most:])
    frames = (_keyframe(folder, session, keyscan, pose) for session, pose, keyscan in found)
    return [frame for frame in frames if frame is not None]


def _keyframe(folder: Path, session: int, keyscan: int, T_own_keyscan: FloatArray) -> KeptKeyframe | None:
    state = _read(folder / f"{session}-{keyscan}{_SUFFIX}")
    if state is None:
        return None
    x, y, z, *rotation = state["camera"].pop("T_base_camera").tolist()
    camera = CameraModel(**state["camera"], T_base_camera=Transform((x, y, z), tuple(rotation)))
    surroundings = tuple(
        LidarView(view["returns"], view["origin"], view["spacing_rad"]) for view in state["surroundings"].values()
    )
    image = KeyframeImage(keyscan, state["encoded"].tobytes(), camera, surroundings, state["T_keyscan_image"])
    features = ImageFeatures(
        frozen(state["keypoints_px"], np.float32),
        frozen(state["scores"], np.float32),
        frozen(state["descriptors"], np.uint8),
    )
    return KeptKeyframe(
        session, image, features, state["detector_version"], se2.compose(T_own_keyscan, image.T_keyscan_image)
    )


def _read(path: Path) -> State | None:
    try:
        return read_state(path, FITS)
    except InputError:
        return None
