"""An occupancy map as the two files that ROS map_server reads: an image and what the image means."""

from enum import IntEnum
from typing import Final, Protocol

import numpy as np
import yaml
from numpy.typing import NDArray

OCCUPIED_THRESHOLD: Final = 0.65
FREE_THRESHOLD: Final = 0.196
"""map_server: occupied above, free below, unknown between; a pixel p stands for the occupancy (255 - p) / 255."""


class Occupancy(IntEnum):
    """What is known of a cell."""

    UNKNOWN = 0
    FREE = 1
    OCCUPIED = 2


PIXELS: Final = {Occupancy.UNKNOWN: 205, Occupancy.FREE: 254, Occupancy.OCCUPIED: 0}

Cells = NDArray[np.uint8]


class OccupancyMap(Protocol):
    """A map whose cells have been decided."""

    @property
    def cells(self) -> Cells:
        """``Occupancy`` of every cell, shape (H, W), row 0 at the lowest y."""

    @property
    def resolution_m(self) -> float:
        """Side of a cell."""

    @property
    def origin_xy(self) -> tuple[float, float]:
        """Lower left corner of cell (0, 0) in the map's frame."""


def pgm_bytes(occupancy: OccupancyMap) -> bytes:
    """The map as a binary PGM for map_server: row 0 at the highest y; 254 free, 0 occupied, 205 unknown."""
    pixels = np.zeros(len(Occupancy), np.uint8)
    for known, pixel in PIXELS.items():
        pixels[known] = pixel
    height, width = occupancy.cells.shape
    return f"P5\n{width} {height}\n255\n".encode("ascii") + pixels[occupancy.cells[::-1]].tobytes()


def map_yaml(occupancy: OccupancyMap, image: str) -> str:
    """What map_server needs to know about the PGM file named ``image``, which lies beside the YAML file."""
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
