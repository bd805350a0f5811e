"""Reads a TUM RGB-D sequence (Sturm et al. 2012): images, depth, and camera poses."""

from dataclasses import dataclass
from pathlib import Path
from typing import Final

import cv2
import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from fcslam.errors import EvaluationError
from fcslam.features.files import read_grey
from fcslam.lab.evaluation.places.view_overlap import DepthCamera
from fcslam.records import FloatArray
from fcslam.untrusted import read_bytes, read_text

DEPTH_UNITS_PER_M: Final = 5000.0
GAP_S: Final = 0.2
"""Largest time between an image and the poses before and after it; these cameras turn fast."""


@dataclass(frozen=True, slots=True)
class Sequence:
    """The images with a known pose, in the order of time."""

    images: tuple[Path, ...]
    stamps: FloatArray
    """Shape (N,), seconds."""
    depths_m: FloatArray
    """Shape (N, H, W); 0 if unknown."""
    T_world_camera: FloatArray
    """Shape (N, 4, 4)."""
    camera: DepthCamera


def read_sequence(folder: Path) -> Sequence:
    """Read ``associations.txt``, ``groundtruth.txt``, and ``calibration.txt`` in the folder or its parent.

    The calibration has lines ``name fx fy cx cy k1 k2 p1 p2 k3``, in pixels of the colour images; the folder's name
    begins with the camera's, perhaps after ``rgbd_dataset_``. Depth may be smaller by a whole factor.

    Raises:
        EvaluationError: a file is missing or does not fit.
        OSError, ValueError: a file cannot be read.
    """
    lines = [line.split() for line in _lines(folder / "associations.txt")]
    poses = np.array([[float(word) for word in line.split()] for line in _lines(folder / "groundtruth.txt")])
    if poses.ndim != 2 or poses.shape[1] != 8 or len(poses) < 2 or (np.diff(poses[:, 0]) <= 0.0).any():
        raise EvaluationError(f"{folder / 'groundtruth.txt'}: needs lines of stamp x y z qx qy qz qw, in order of time")
    lines = [line for line in lines if _is_covered(float(line[0]), poses[:, 0])]
    if not lines:
        raise EvaluationError(f"{folder}: no image at a time when its pose is known")
    images = tuple(folder / line[1] for line in lines)
    depths_m = np.stack([_read_depth(folder / line[3]) for line in lines])
    stamps = np.array([float(line[0]) for line in lines])
    factor = read_grey(images[0]).shape[1] / depths_m.shape[2]
    calibration = _calibration(folder)
    camera = DepthCamera(calibration[:4] / factor, calibration[4:])
    return Sequence(images, stamps, depths_m, _poses_at(stamps, poses), camera)


def _lines(path: Path) -> list[str]:
    try:
        text = read_text(path)
    except OSError as error:
        raise EvaluationError(f"{path}: cannot be read ({error}); a sequence needs it") from error
    return [line for line in text.splitlines() if line.strip() and not line.startswith("#")]


def _is_covered(stamp: float, known: FloatArray) -> bool:
    """Whether poses exist shortly before and after."""
    after = int(np.searchsorted(known, stamp))
    return 0 < after < len(known) and max(stamp - known[after - 1], known[after] - stamp) <= GAP_S


def _poses_at(stamps: FloatArray, poses: FloatArray) -> FloatArray:
    """Interpolate poses at ``stamps`` (N,), linear and slerp: shape (N, 4, 4)."""
    T = np.tile(np.eye(4), (len(stamps), 1, 1))
    T[:, :3, :3] = Slerp(poses[:, 0], Rotation.from_quat(poses[:, 4:]))(stamps).as_matrix()
    for axis in range(3):
        T[:, axis, 3] = np.interp(stamps, poses[:, 0], poses[:, 1 + axis])
    return T


def _read_depth(path: Path) -> FloatArray:
    depth = cv2.imdecode(np.frombuffer(read_bytes(path), np.uint8), cv2.IMREAD_UNCHANGED)
    if depth is None or depth.dtype != np.uint16 or depth.ndim != 2:
        raise EvaluationError(f"{path}: no depth image of 16 bits")
    return np.asarray(depth, np.float64) / DEPTH_UNITS_PER_M


def _calibration(folder: Path) -> FloatArray:
    path = next(
        (
            place / "calibration.txt"
            for place in (folder, folder.resolve().parent)
            if (place / "calibration.txt").is_file()
        ),
        folder / "calibration.txt",
    )
    name = folder.resolve().name.removeprefix("rgbd_dataset_")
    for line in _lines(path):
        camera, *numbers = line.split()
        if name.startswith(camera) and len(numbers) == 9:
            return np.array([float(number) for number in numbers])
    raise EvaluationError(f"{path}: has no camera whose name {name} begins with")
