"""The joint map of robots with 3D LiDARs: all voxel maps at their poses, as a point cloud file."""

from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from fcslam.geometry import se3
from fcslam.records import FloatArray, VoxelMap

_CELL_M: Final = 0.1
_NORMAL_M: Final = 0.35
"""Points so near give the direction of a surface."""
_FEWEST: Final = 4
_COLOURS: Final = np.array([(68, 1, 84), (59, 82, 139), (33, 145, 140), (94, 201, 98), (253, 231, 37)], np.float64)
"""From low to high: five colours of the map viridis."""

_TYPE: Final = np.dtype([*((name, "<f4") for name in ("x", "y", "z", "nx", "ny", "nz")), *((c, "u1") for c in "rgb")])
_HEADER: Final = """ply
format binary_little_endian 1.0
comment points of {count} voxels of {cell:g} m with normals, coloured by height
element vertex {count}
property float x
property float y
property float z
property float nx
property float ny
property float nz
property uchar red
property uchar green
property uchar blue
end_header
"""


def joint_points(maps: Sequence[tuple[VoxelMap, FloatArray]]) -> tuple[FloatArray, FloatArray]:
    """Points (N, 3) and normals (N, 3) of voxel maps, given with ``T_map_base`` (7,) of their keyscans.

    Each voxel of the joint map has the middle of its points. Normals face the scanner that was nearest.
    """
    T_map_ground = np.array([se3.compose(pose, voxels.T_base_ground) for voxels, pose in maps])
    points = np.concatenate([se3.transform(T, v.points_m) for T, (v, _) in zip(T_map_ground, maps, strict=True)])
    origins = np.concatenate([se3.transform(T, v.origins_m) for T, (v, _) in zip(T_map_ground, maps, strict=True)])
    cells = np.floor(points / _CELL_M).astype(np.int64)
    _, number, counts = np.unique(cells, axis=0, return_inverse=True, return_counts=True)
    middles = np.column_stack([np.bincount(number.ravel(), axis) for axis in points.T]) / counts[:, None]
    return middles, _normals(middles, origins)


def _normals(points: FloatArray, origins: FloatArray) -> FloatArray:
    """The direction in which the points around each one spread least; zero where there are too few."""
    from scipy.spatial import cKDTree

    tree = cKDTree(points)
    pairs = tree.query_pairs(_NORMAL_M, output_type="ndarray")
    i, j = np.concatenate((pairs, pairs[:, ::-1])).T
    count = np.bincount(i, minlength=len(points))
    offset = points[j] - points[i]
    mean = np.column_stack([np.bincount(i, axis, len(points)) for axis in offset.T]) / np.maximum(count, 1)[:, None]
    spread = np.empty((len(points), 3, 3))
    for r in range(3):
        for c in range(3):
            spread[:, r, c] = np.bincount(i, offset[:, r] * offset[:, c], len(points)) / np.maximum(count, 1)
    spread -= mean[:, :, None] * mean[:, None, :]
    normals = np.linalg.eigh(spread)[1][:, :, 0]
    towards = origins[cKDTree(origins).query(points)[1]] - points
    facing = np.where((normals * towards).sum(axis=1) < 0.0, -1.0, 1.0)
    return np.asarray(normals * (facing * (count >= _FEWEST))[:, None], np.float64)


def ply_of(maps: Sequence[tuple[VoxelMap, FloatArray]]) -> bytes:
    """The joint map as a PLY file, binary and little endian, coloured by height."""
    points, normals = joint_points(maps)
    rows = np.zeros(len(points), _TYPE)
    for column, values in zip("xyz", points.T, strict=True):
        rows[column] = values
    for column, values in zip(("nx", "ny", "nz"), normals.T, strict=True):
        rows[column] = values
    for column, channel in zip("rgb", _colours(points[:, 2]).T, strict=True):
        rows[column] = channel
    return _HEADER.format(count=len(points), cell=_CELL_M).encode() + rows.tobytes()


def _colours(heights_m: FloatArray) -> NDArray[np.uint8]:
    low, high = np.quantile(heights_m, (0.02, 0.98))
    share = np.clip((heights_m - low) / max(high - low, _CELL_M), 0.0, 1.0) * (len(_COLOURS) - 1)
    channels = [np.interp(share, np.arange(len(_COLOURS)), channel) for channel in _COLOURS.T]
    return np.asarray(np.rint(np.column_stack(channels)), np.uint8)
