"""An occupancy map as the two files that ROS map_server reads: an image and its description. Writer and reader."""

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from enum import IntEnum
from typing import Any, Final

import numpy as np
import yaml
from numpy.typing import NDArray

from fcslam.config import one_line, parse_yaml
from fcslam.errors import InputError
from fcslam.records import frozen

OCCUPIED_THRESHOLD: Final = 0.65
FREE_THRESHOLD: Final = 0.196
"""map_server: occupied above, free below, unknown between; a pixel p stands for the occupancy (255 - p) / 255."""

_PGM_HEADER: Final = re.compile(rb"P5\s+(?:#[^\n]*\n\s*)*([1-9]\d{0,6})\s+([1-9]\d{0,6})\s+255\s")
"""Width, height; other programs write a comment after the first line."""


GEOREFERENCE: Final = "_georeference.json"
"""End of the name of the file, beside a map, that says how the map lies on the earth."""
RMF_YAML: Final = "rmf.yaml"
"""Name of the file that says where Open-RMF has the map."""
FINEST_M: Final = 1e-4
COARSEST_M: Final = 1e3
FARTHEST_M: Final = 1e7
"""Limits of a map's cells, and of its origin and poses: farther from the origin, floats do not resolve cells."""
HEADER_BYTES: Final = 4096
"""Largest header of an image: longer comments are not read."""


class Occupancy(IntEnum):
    """State of a cell."""

    UNKNOWN = 0
    FREE = 1
    OCCUPIED = 2


PIXELS: Final = {Occupancy.UNKNOWN: 205, Occupancy.FREE: 254, Occupancy.OCCUPIED: 0}

Cells = NDArray[np.uint8]


@dataclass(frozen=True, slots=True, eq=False)
class OccupancyMap:
    """An occupancy grid whose cells are classified as occupied, free or unknown."""

    cells: Cells
    """``Occupancy`` of every cell, shape (H, W). Rows run along y and columns along x, from the lowest value up."""
    resolution_m: float
    """Side of a cell."""
    origin_xy: tuple[float, float]
    """Lower left corner of cell (0, 0) in the coordinate frame of the map, metres."""
    floor: str = ""
    """Floor that the map shows, if it is known."""


def map_stem(number: int) -> str:
    """Beginning of the names of the map's files in a run folder: ``map`` for map 0, ``map_1`` for map 1."""
    return f"map_{number}" if number else "map"


def pgm_bytes(occupancy: OccupancyMap) -> bytes:
    """The map as a binary PGM for map_server: row 0 at the highest y; 254 free, 0 occupied, 205 unknown."""
    height, width = occupancy.cells.shape
    return f"P5\n{width} {height}\n255\n".encode("ascii") + pixels_of(occupancy.cells[::-1]).tobytes()


def pixels_of(cells: Cells) -> NDArray[np.uint8]:
    """The grey values of map_server for ``Occupancy`` of cells, in the same shape."""
    pixels = np.zeros(256, np.uint8)
    for known, pixel in PIXELS.items():
        pixels[known] = pixel
    return _looked_up(pixels, cells)


def _looked_up(table: NDArray[np.uint8], values: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """``table[values]``, bytes by bytes: an index array would take eight times as much memory."""
    return np.frombuffer(values.tobytes().translate(table.tobytes()), np.uint8).reshape(values.shape)


def map_yaml(occupancy: OccupancyMap, image: str) -> str:
    """YAML text for map_server about the PGM file named ``image``, which lies beside it."""
    content = {
        "image": image,
        "mode": "trinary",
        "resolution": occupancy.resolution_m,
        "origin": [*(round(value, 9) for value in occupancy.origin_xy), 0.0],
        "negate": 0,
        "occupied_thresh": OCCUPIED_THRESHOLD,
        "free_thresh": FREE_THRESHOLD,
    }
    text: str = yaml.safe_dump(content, sort_keys=False, default_flow_style=None)
    return text


def server_files(stem: str, occupancy: OccupancyMap) -> dict[str, bytes]:
    """The map as ``<stem>.pgm`` and ``<stem>.yaml`` for map_server."""
    image = f"{stem}.pgm"
    return {image: pgm_bytes(occupancy), f"{stem}.yaml": map_yaml(occupancy, image).encode()}


def parse_map(name: str, pgm: bytes, description: str) -> OccupancyMap:
    """Read back what ``pgm_bytes`` and ``map_yaml`` wrote; also what map_server saves in the mode trinary.

    Messages call the map ``name``; the image that the description names is not opened.
    """
    try:
        width, height, begin = _size(pgm)
        if len(pgm) - begin != width * height:
            raise ValueError(f"the image has {len(pgm) - begin} pixels, not {width} x {height}")
        resolution_m, origin_xy, occupied_threshold, free_threshold = _own_description(description)
    except ValueError as error:
        raise InputError(f"{name} is broken: {one_line(str(error))}") from error
    occupancy = (255 - np.arange(256)) / 255.0
    meaning = np.full(256, Occupancy.UNKNOWN, np.uint8)
    meaning[occupancy < free_threshold] = Occupancy.FREE
    meaning[occupancy > occupied_threshold] = Occupancy.OCCUPIED
    pixels = np.frombuffer(pgm, np.uint8, offset=begin).reshape(height, width)
    return OccupancyMap(frozen(_looked_up(meaning, pixels[::-1]), np.uint8), resolution_m, origin_xy)


def area_of(name: str, header: bytes, description: str) -> tuple[float, tuple[float, float, float, float]]:
    """Read the side of a cell, and the lowest x and y and highest x and y of a map, metres.

    From the first ``HEADER_BYTES`` of its image and its YAML file. ``name`` and errors as for ``parse_map``.
    """
    try:
        width, height, _ = _size(header)
        resolution_m, (x, y), *_ = _own_description(description)
    except ValueError as error:
        raise InputError(f"{name} is broken: {one_line(str(error))}") from error
    return resolution_m, (x, y, x + width * resolution_m, y + height * resolution_m)


def _size(pgm: bytes) -> tuple[int, int, int]:
    """Width and height of the image, and where its pixels begin."""
    header = _PGM_HEADER.match(pgm)
    if header is None:
        raise ValueError("the image is not a binary PGM of 8 bits")
    return int(header[1]), int(header[2]), header.end()


def _own_description(description: str) -> tuple[float, tuple[float, float], float, float]:
    """Resolution, origin, threshold of occupied cells, threshold of free cells."""
    content, resolution_m, (x, y, theta), occupied, free = read_description(description)
    if not 0.0 <= free <= occupied <= 1.0:
        raise ValueError("the description needs 0 <= `free_thresh` <= `occupied_thresh` <= 1")
    if content.get("negate", 0) or content.get("mode", "trinary") != "trinary" or theta != 0.0:
        raise ValueError("the description needs `negate` 0, `mode` trinary and a theta of 0 in `origin`")
    return resolution_m, (x, y), occupied, free


def read_description(description: str) -> tuple[dict[str, Any], float, tuple[float, float, float], float, float]:
    """Content, resolution (m), origin (m, m, rad) and thresholds of occupied and free cells in a map's YAML file."""
    content: Any = parse_yaml(description)
    if not isinstance(content, dict):
        raise ValueError("the description is not a YAML mapping")
    resolution_m, occupied, free = (number_in(content, key) for key in ("resolution", "occupied_thresh", "free_thresh"))
    origin = content.get("origin")
    if not isinstance(origin, list) or len(origin) != 3:
        raise ValueError("`origin` in the description must be [x, y, theta]")
    x, y, theta = (number_in({"origin": value}, "origin") for value in origin)
    check_place(resolution_m, x, y)
    return content, resolution_m, (x, y, theta), occupied, free


def check_place(resolution_m: float, x: float, y: float) -> None:
    """Check resolution and origin of a map: far off, its cells have no finite size or place."""
    if not FINEST_M <= resolution_m <= COARSEST_M:
        raise ValueError(f"`resolution` is {resolution_m:g}; give the side of a cell, {FINEST_M:g} to {COARSEST_M:g} m")
    if max(abs(x), abs(y)) > FARTHEST_M:
        raise ValueError(f"`origin` is ({x:g}, {y:g}); its limit is {FARTHEST_M:g} m")


def number_in(description: Mapping[str, object], key: str) -> float:
    """A finite number of the description; YAML 1.1 reads ``5e-2`` as text."""
    value = description.get(key)
    try:
        number = float(value) if isinstance(value, int | float | str) else math.nan
    except (ValueError, OverflowError):
        number = math.nan
    if not math.isfinite(number):
        raise ValueError(f"`{key}` in the description {'is missing' if value is None else 'is not a finite number'}")
    return number
