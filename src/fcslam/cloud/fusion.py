"""One occupancy map from the keyscans of several robots, and its files for ROS map_server."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import yaml

from fcslam.lidar.occupancy import Cells, Occupancy, OccupancyConfig, OccupancyGrid, cast, classify
from fcslam.records import FloatArray, Keyscan, LaserModel

OCCUPIED_THRESHOLD: Final = 0.65
FREE_THRESHOLD: Final = 0.196
"""map_server: occupied above, free below, unknown between; a pixel p stands for the occupancy (255 - p) / 255."""

PIXELS: Final = {Occupancy.UNKNOWN: 205, Occupancy.FREE: 254, Occupancy.OCCUPIED: 0}


@dataclass(frozen=True, slots=True)
class FusedMap:
    """The map of robots whose poses are known in one ``map``."""

    grid: OccupancyGrid
    cells: Cells
    """``Occupancy`` of every cell, shape (H, W), row 0 at the lowest y."""


def fuse(
    keyscans: Sequence[Keyscan], T_map_base: FloatArray, lasers: Mapping[str, LaserModel], config: OccupancyConfig
) -> FusedMap:
    """Map of all keyscans at their poses (N, 3); ``lasers`` holds each robot's own. The order does not matter.

    Raises:
        ValueError: poses do not fit the keyscans, ranges do not fit the laser, or a pose is not finite.
        KeyError: a keyscan's robot has no laser.
    """
    castings = [
        (keyscan.ranges_m, lasers[keyscan.id.robot], pose) for keyscan, pose in zip(keyscans, T_map_base, strict=True)
    ]
    grid = cast(castings, config)
    return FusedMap(grid, classify(grid, config))


def pgm_bytes(fused: FusedMap) -> bytes:
    """The map as a binary PGM for map_server: row 0 at the highest y; 254 free, 0 occupied, 205 unknown."""
    pixels = np.zeros(len(Occupancy), np.uint8)
    for occupancy, pixel in PIXELS.items():
        pixels[occupancy] = pixel
    height, width = fused.cells.shape
    return f"P5\n{width} {height}\n255\n".encode("ascii") + pixels[fused.cells[::-1]].tobytes()


def map_yaml(fused: FusedMap, image: str) -> str:
    """What map_server needs to know about the PGM file named ``image``, which lies beside the YAML file."""
    content = {
        "image": image,
        "mode": "trinary",
        "resolution": fused.grid.resolution_m,
        "origin": [*(round(value, 9) for value in fused.grid.origin_xy), 0.0],
        "negate": 0,
        "occupied_thresh": OCCUPIED_THRESHOLD,
        "free_thresh": FREE_THRESHOLD,
    }
    text: str = yaml.safe_dump(content, sort_keys=False, default_flow_style=None)
    return text
