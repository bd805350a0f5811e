"""The joint map of robots with 3D LiDARs: all voxel maps at their poses, as a point cloud file."""

from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from fcslam.errors import SourceError
from fcslam.geometry import se3
from fcslam.geometry.voxels import VOXEL_STEPS
from fcslam.maps.occupancy_map import FARTHEST_M
from fcslam.records import STEP_M, FloatArray, VoxelMap

_CELL_M: Final = VOXEL_STEPS * STEP_M
_NEIGHBOURS: Final = 12
"""Points that give the direction of a surface."""
_AT_ONCE: Final = 50_000
_COLOURS: Final = np.array([(68, 1, 84), (59, 82, 139), (33, 145, 140), (94, 201, 98), (253, 231, 37)], np.float64)
"""From low to high: five colours of the map viridis."""

_NORMAL: Final = "nx", "ny", "nz"
_TYPE: Final = np.dtype([*((name, "<f4") for name in ("x", "y", "z", *_NORMAL)), *((c, "u1") for c in "rgb")])
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


def joint_voxels(maps: Sequence[tuple[VoxelMap, FloatArray]]) -> tuple[FloatArray, FloatArray]:
    """The middle of the points of each voxel (N, 3), and where a scanner saw it from (N, 3).

    The voxel maps are given with ``T_map_base`` (7,) of their keyscans.
    """
    T_map_ground = [se3.compose(pose, voxels.T_base_ground) for voxels, pose in maps]
    placed = list(zip(T_map_ground, (voxels for voxels, _ in maps), strict=True))
    points = np.concatenate([se3.transform(T, voxels.points_m) for T, voxels in placed])
    origins = np.concatenate([se3.transform(T, voxels.origins_m)[voxels.seen_from] for T, voxels in placed])
    cells = np.floor(points / _CELL_M).astype(np.int64)
    _, number, counts = np.unique(cells, axis=0, return_inverse=True, return_counts=True)
    number = number.ravel()
    middles = np.column_stack([np.bincount(number, axis) for axis in points.T]) / counts[:, None]
    scanner = np.zeros_like(middles)
    scanner[number] = origins
    return middles, scanner


def _normals(points: FloatArray, scanner: FloatArray) -> FloatArray:
    """The direction in which the neighbours of each point spread least, towards the scanner that saw it."""
    from scipy.spatial import cKDTree

    tree, count = cKDTree(points), min(_NEIGHBOURS, len(points))
    normals = np.zeros_like(points)
    for start in range(0, len(points), _AT_ONCE):  # the neighbours of all points of a large building are gigabytes
        part = slice(start, start + _AT_ONCE)
        around = points[tree.query(points[part], count)[1].reshape(-1, count)]
        around -= around.mean(axis=1, keepdims=True)
        normals[part] = np.linalg.eigh(np.einsum("nka,nkb->nab", around, around))[1][:, :, 0]
    facing = np.where((normals * (scanner - points)).sum(axis=1) < 0.0, -1.0, 1.0)
    return np.asarray(normals * facing[:, None], np.float64)


def ply_of(maps: Sequence[tuple[VoxelMap, FloatArray]]) -> bytes:
    """The joint map as a PLY file, binary and little endian, coloured by height."""
    points, scanner = joint_voxels(maps)
    rows = np.zeros(len(points), _TYPE)
    for column, values in zip("xyz", points.T, strict=True):
        rows[column] = _rounded(values, 1024)
    for column, values in zip(_NORMAL, _normals(points, scanner).T, strict=True):
        rows[column] = _rounded(values, 128)
    for column, channel in zip("rgb", _colours(points[:, 2]).T, strict=True):
        rows[column] = channel
    return _head(len(points)) + rows.tobytes()


def read_points(ply: bytes, name: str) -> tuple[FloatArray, FloatArray]:
    """Points (N, 3) and normals (N, 3) of a file that ``ply_of`` made and messages call ``name``."""
    head, mark, body = ply.partition(b"end_header\n")
    rows = np.frombuffer(body[: len(body) // _TYPE.itemsize * _TYPE.itemsize], _TYPE)
    if not len(rows) or head + mark + rows.tobytes() != ply or head + mark != _head(len(rows)):
        raise SourceError(f"{name}: is not a file of points that `fcslam map --3d` wrote; copy it again")
    points, normals = (np.column_stack([rows[c] for c in names]).astype(np.float64) for names in ("xyz", _NORMAL))
    if not ((np.abs(points) <= FARTHEST_M).all() and np.isfinite(normals).all()):
        raise SourceError(f"{name}: has points that no map has; copy it again")
    return points, normals


def _head(count: int) -> bytes:
    return _HEADER.format(count=count, cell=_CELL_M).encode()


def _rounded(values: FloatArray, steps: int) -> FloatArray:
    """To steps of a unit: less than half as many bytes, compressed."""
    return np.rint(values * steps) / steps


def _colours(heights_m: FloatArray) -> NDArray[np.uint8]:
    low, high = np.quantile(heights_m, (0.02, 0.98))
    share = np.clip((heights_m - low) / max(high - low, _CELL_M), 0.0, 1.0) * (len(_COLOURS) - 1)
    channels = [np.interp(share, np.arange(len(_COLOURS)), channel) for channel in _COLOURS.T]
    return np.asarray(np.rint(np.column_stack(channels)), np.uint8)
