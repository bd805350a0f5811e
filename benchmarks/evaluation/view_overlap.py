"""Overlap of two depth images with known camera poses.

Pixels of one image are projected into the other by their depth, both poses and the lens distortion. A pixel is visible
there if the depths agree.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp

from fcslam.compiled import njit
from fcslam.errors import InputError
from fcslam.features.files import read_grey
from fcslam.records import FloatArray
from fcslam.untrusted import read_bytes, read_text

DEPTH_AGREEMENT = 0.1
"""Largest relative difference of two depths of one surface."""
SAME_OVERLAP, OTHER_OVERLAP = 0.5, 0.1
"""Two views show one place above the first overlap, and different places below the second."""
STRIDE_PX = 8
"""Sampling step in columns and rows of the depth image."""
_BEYOND = 1.1
"""Validity of the distortion polynomial, as a multiple of the largest corner ray."""


@dataclass(frozen=True, slots=True)
class DepthCamera:
    """A camera with its lens, in pixels of the depth images."""

    intrinsics: FloatArray
    """fx, fy, cx, cy."""
    distortion: FloatArray
    """k1, k2, p1, p2, k3 (Brown-Conrady, as OpenCV has it)."""


def view_overlap(depths_m: FloatArray, T_world_camera: FloatArray, camera: DepthCamera) -> FloatArray:
    """Share of the pixels of one image that are visible in the other, the smaller of both directions.

    Depths (N, H, W) along the optical axis, 0 if unknown; poses (N, 4, 4) of one camera. Returns shares in [0, 1],
    shape (N, N).
    """
    _, height, width = depths_m.shape
    columns, rows = np.meshgrid(np.arange(0, width, STRIDE_PX), np.arange(0, height, STRIDE_PX))
    pixels = np.column_stack((columns.ravel(), rows.ravel()))
    fx, fy, cx, cy = camera.intrinsics
    matrix = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    corners = np.array([[0, 0], [width - 1, 0], [0, height - 1], [width - 1, height - 1]], np.float64)
    rays, far = (
        cv2.undistortPoints(points.astype(np.float64)[:, None], matrix, camera.distortion)[:, 0]
        for points in (pixels, corners)
    )
    limit = _BEYOND * float(np.linalg.norm(far, axis=1).max())
    lens = np.concatenate((camera.intrinsics, camera.distortion))
    seen = _seen_again(np.ascontiguousarray(depths_m), T_world_camera, pixels, np.ascontiguousarray(rays), lens, limit)
    return np.asarray(np.minimum(seen, seen.T))


@njit
def _seen_again(
    depths_m: FloatArray,
    T_world_camera: FloatArray,
    pixels: NDArray[np.int64],
    rays: FloatArray,
    lens: FloatArray,
    limit: float,
) -> FloatArray:
    """Share of the pixels of image a (row) that are visible in image b (column), shape (N, N).

    Pixels without a depth in a, or projected to a pixel without a depth in b, are ignored.
    """
    count = depths_m.shape[0]
    shares = np.zeros((count, count))
    for a in range(count):
        for b in range(count):
            T_b_a = np.linalg.inv(T_world_camera[b]) @ T_world_camera[a]
            judged = again = 0
            for k in range(pixels.shape[0]):
                depth = depths_m[a, pixels[k, 1], pixels[k, 0]]
                if depth <= 0.0:
                    continue
                judged += 1
                x, y = depth * rays[k, 0], depth * rays[k, 1]
                z = T_b_a[2, 0] * x + T_b_a[2, 1] * y + T_b_a[2, 2] * depth + T_b_a[2, 3]
                if z <= 0.0:
                    continue
                u, v = _distorted(
                    (T_b_a[0, 0] * x + T_b_a[0, 1] * y + T_b_a[0, 2] * depth + T_b_a[0, 3]) / z,
                    (T_b_a[1, 0] * x + T_b_a[1, 1] * y + T_b_a[1, 2] * depth + T_b_a[1, 3]) / z,
                    lens,
                    limit,
                )
                column, row = int(np.floor(u + 0.5)), int(np.floor(v + 0.5))
                if 0 <= column < depths_m.shape[2] and 0 <= row < depths_m.shape[1]:
                    there = depths_m[b, row, column]
                    if there > 0.0:
                        again += abs(there - z) <= DEPTH_AGREEMENT * z
                    else:
                        judged -= 1  # unknown whether it is the same surface
            if judged:
                shares[a, b] = again / judged
    return shares


@njit
def _distorted(x: float, y: float, lens: FloatArray, limit: float) -> tuple[float, float]:
    """Project a ray (x, y, 1) to a pixel; (-2, -2) outside the validity of the distortion model."""
    r2 = x * x + y * y
    if r2 > limit * limit:
        return -2.0, -2.0
    fx, fy, cx, cy, k1, k2, p1, p2, k3 = lens
    radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
    u = x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x)
    v = y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y
    return fx * u + cx, fy * v + cy


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
        InputError: a file is missing or does not fit.
        OSError, ValueError: a file cannot be read.
    """
    lines = [line.split() for line in _lines(folder / "associations.txt")]
    poses = np.array([[float(word) for word in line.split()] for line in _lines(folder / "groundtruth.txt")])
    if poses.ndim != 2 or poses.shape[1] != 8 or len(poses) < 2 or (np.diff(poses[:, 0]) <= 0.0).any():
        raise InputError(f"{folder / 'groundtruth.txt'}: needs lines of stamp x y z qx qy qz qw, in order of time")
    lines = [line for line in lines if _is_covered(float(line[0]), poses[:, 0])]
    if not lines:
        raise InputError(f"{folder}: no image at a time when its pose is known")
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
        raise InputError(f"{path}: cannot be read ({error}); a sequence needs it") from error
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
        raise InputError(f"{path}: no depth image of 16 bits")
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
    raise InputError(f"{path}: has no camera whose name {name} begins with")
