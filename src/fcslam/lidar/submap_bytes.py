"""A submap as bytes: its arrays one after the other, for other processes and for files. Nothing in them is executed."""

import json
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fcslam.lidar.field import FieldArrays, SurfelField
from fcslam.lidar.scan import PointScan
from fcslam.lidar.submap import FreeSpace, Submap

_HEADER = 4
"""Bytes of the length of the header, big-endian."""


def submap_bytes(submap: Submap) -> bytes:
    """The same bytes for the same submap, on every machine with this byte order."""
    surface, free = submap.surface, submap.free
    arrays = (
        *submap.field.arrays,
        surface.points,
        surface.normals,
        surface.solitary,
        surface.origin,
        free.cells,
        free.corner,
    )
    return _pack(arrays)


def read_submap(data: bytes) -> Submap:
    """The submap of ``submap_bytes``. Its arrays are copies, so that compiled code sees arrays as it knows them."""
    *field, points, normals, solitary, origin, cells, corner = _unpack(data)
    surface = PointScan(points, normals, solitary, origin)
    return Submap(SurfelField.of(FieldArrays(*field)), surface, FreeSpace(cells, corner))


def _pack(arrays: Sequence[NDArray[Any]]) -> bytes:
    header = json.dumps([(array.dtype.str, array.shape) for array in arrays]).encode()
    return b"".join((len(header).to_bytes(_HEADER, "big"), header, *(array.tobytes() for array in arrays)))


def _unpack(data: bytes) -> list[NDArray[Any]]:
    begin = _HEADER + int.from_bytes(data[:_HEADER], "big")
    arrays = []
    for kind, shape in json.loads(data[_HEADER:begin]):
        count = int(np.prod(shape))
        array = np.frombuffer(data, np.dtype(kind), count, begin).reshape(shape).copy()
        arrays.append(array)
        begin += array.nbytes
    return arrays
