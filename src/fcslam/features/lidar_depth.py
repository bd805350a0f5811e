"""Metric positions of image keypoints: bearing from the camera, depth from the LiDAR.

Walls, cupboards and door frames are vertical. So a point above or below the scan plane is assumed to lie, seen from
above, where the LiDAR measures a surface in its direction. A keypoint is dropped if the LiDAR has no return in its
direction. It is also dropped if the ray would be below the floor or above ``CEILING_M`` there, because it hit the floor
or the ceiling first. Objects that overhang the scan plane, such as a table top, get a wrong depth. RANSAC and the
verification of the submaps reject them.
"""

from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fcslam.compiled import njit
from fcslam.records import CameraModel, FloatArray

CEILING_M = 3.0
"""Keypoints higher above the floor have no position: the LiDAR does not see the ceiling."""
FLOOR_MARGIN_M: Final = 0.03
"""Keypoints at most this high are dropped, because they may lie on the floor."""
NEIGHBOURS_M: Final = 0.20
"""Neighbouring returns closer than this lie on one surface."""
SLANT: Final = 4.0
"""Neighbouring returns are of one surface, at a grazing angle, up to this many times the spacing of beams there."""
WIDEST_GAP: Final = 2.5
"""Largest gap between the returns of a surface, in beam spacings: one beam in between may fail."""
EDGE_M: Final = 0.08
"""A ray that passes the edge of a surface this closely ends there, because keypoints often lie on edges."""


class LidarView(NamedTuple):
    """One scan in the coordinate frame ``base`` at the image's stamp."""

    returns: FloatArray
    """Shape (N, 2), metres, in the order of their beams."""
    origin: FloatArray
    """Position of the LiDAR, shape (2,), metres."""
    spacing_rad: float
    """Angle between neighbouring beams."""


def locate_keypoints(
    keypoints_px: NDArray[np.float32], camera: CameraModel, lidar: LidarView
) -> tuple[FloatArray, NDArray[np.bool_]]:
    """Positions (K, 3) of keypoints (K, 2) in ``base`` by the LiDAR range in their direction, and which have one, (K,).

    ``base`` lies on the floor; the LiDAR scanned at the image's stamp. Keypoints above ``CEILING_M`` have no position;
    then it is 0.
    """
    rays = _rays(keypoints_px.astype(np.float64), camera)
    level = np.hypot(rays[:, 0], rays[:, 1])
    eye, height = np.array(camera.T_base_camera.translation_m[:2]), camera.T_base_camera.translation_m[2]
    directions = rays[:, :2] / np.maximum(level, 1e-9)[:, None]
    distances = _distances(eye, directions, lidar.returns, lidar.origin, WIDEST_GAP * lidar.spacing_rad)
    heights = height + distances * rays[:, 2] / np.maximum(level, 1e-9)
    placed = np.isfinite(distances) & (heights > FLOOR_MARGIN_M) & (heights < CEILING_M)
    positions = np.column_stack((eye + distances[:, None] * directions, heights))
    return np.where(placed[:, None], positions, 0.0), placed


def locate_among(
    keypoints_px: NDArray[np.float32], camera: CameraModel, surroundings: Sequence[LidarView]
) -> tuple[FloatArray, NDArray[np.bool_]]:
    """``locate_keypoints`` with several LiDARs: what one does not see, another one may."""
    positions, placed = np.zeros((len(keypoints_px), 3)), np.zeros(len(keypoints_px), np.bool_)
    for lidar in surroundings:
        found, is_found = locate_keypoints(keypoints_px, camera, lidar)
        fresh = is_found & ~placed
        positions[fresh], placed = found[fresh], placed | is_found
    return positions, placed


def project(positions: FloatArray, camera: CameraModel) -> FloatArray:
    """Pixels (K, 2) of positions (K, 3) in ``base``, metres, wherever they are; NaN behind the camera."""
    seen = (positions - camera.T_base_camera.translation_m) @ camera.T_base_camera.rotation_matrix()
    depth = np.where(seen[:, 2] > 0.0, seen[:, 2], np.nan)
    return np.column_stack((camera.fx * seen[:, 0] / depth + camera.cx, camera.fy * seen[:, 1] / depth + camera.cy))


def _rays(keypoints_px: FloatArray, camera: CameraModel) -> FloatArray:
    """Directions of the viewing rays in ``base``, shape (K, 3)."""
    x = (keypoints_px[:, 0] - camera.cx) / camera.fx
    y = (keypoints_px[:, 1] - camera.cy) / camera.fy
    return np.column_stack((x, y, np.ones(len(x)))) @ camera.T_base_camera.rotation_matrix().T


@njit
def _distances(
    eye: FloatArray, directions: FloatArray, returns: FloatArray, origin: FloatArray, widest_gap_rad: float
) -> FloatArray:
    """Distance (K,) along each ray from ``eye`` to the first surface between neighbouring returns; NaN without one."""
    nearest = np.full(len(directions), np.inf)
    count = len(returns)
    for k in range(count if count > 1 else 0):
        ax, ay = returns[k, 0], returns[k, 1]
        bx, by = returns[(k + 1) % count, 0], returns[(k + 1) % count, 1]
        range_a, range_b = np.hypot(ax - origin[0], ay - origin[1]), np.hypot(bx - origin[0], by - origin[1])
        dot = (ax - origin[0]) * (bx - origin[0]) + (ay - origin[1]) * (by - origin[1])
        cross = (ax - origin[0]) * (by - origin[1]) - (ay - origin[1]) * (bx - origin[0])
        gap = abs(np.arctan2(cross, dot))
        if gap > widest_gap_rad:
            continue
        length = np.hypot(bx - ax, by - ay)
        surface = length < max(NEIGHBOURS_M, SLANT * gap * max(range_a, range_b))
        for i in range(len(directions)):
            distance = _crossing(eye, directions[i], (ax, ay, bx - ax, by - ay))
            if not np.isfinite(distance) or distance >= nearest[i]:
                continue
            if not surface:
                x, y = eye[0] + distance * directions[i, 0], eye[1] + distance * directions[i, 1]
                to_a, to_b = np.hypot(x - ax, y - ay), np.hypot(x - bx, y - by)
                if min(to_a, to_b) > EDGE_M:
                    continue
            nearest[i] = distance
    return np.where(np.isfinite(nearest), nearest, np.nan)


@njit
def _crossing(eye: FloatArray, direction: FloatArray, side: tuple[float, float, float, float]) -> float:
    """Distance along the ray to a segment (start x, y and vector x, y); infinite if they do not intersect."""
    x, y, dx, dy = side
    determinant = direction[1] * dx - direction[0] * dy
    if abs(determinant) < 1e-12:
        return np.inf
    distance = (dx * (y - eye[1]) - dy * (x - eye[0])) / determinant
    share = (direction[0] * (y - eye[1]) - direction[1] * (x - eye[0])) / determinant
    return distance if distance > 0.0 and 0.0 <= share <= 1.0 else np.inf
