"""Overlap of two depth images with known camera poses.

Pixels of one image are projected into the other by their depth, both poses and the lens distortion. A pixel is visible
there if the depths agree.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from fcslam.compiled import njit
from fcslam.records import FloatArray

DEPTH_AGREEMENT = 0.1
"""Largest relative difference of two depths of one surface."""
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
