"""Rotations in three dimensions, for the mounting of sensors."""

import numpy as np

from fcslam.geometry.se2 import Array


def rotation_matrix(quaternion: tuple[float, float, float, float]) -> Array:
    """Rotation matrix, shape (3, 3), of a unit quaternion (x, y, z, w)."""
    x, y, z, w = quaternion
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )
