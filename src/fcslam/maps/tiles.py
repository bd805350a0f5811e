"""Square tiles of a map as pictures, for viewers that show parts of it."""

import math
import threading
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from fcslam.maps.occupancy_map import PIXELS, Occupancy, parse_map, pixels_of
from fcslam.runs.folder import identity
from fcslam.untrusted import read_bytes, read_text

TILE_PX = 512
WORLD_M = 1.0 * TILE_PX
"""Side of a tile at zoom 0, where a pixel is a metre; each zoom halves it."""
DEEPEST_ZOOM = 8
MAPS_KEPT = 4
"""Maps kept in memory, at most 85 MB each."""


def finest_zoom(resolution_m: float) -> int:
    """The zoom whose pixels are no larger than cells; deeper ones show nothing more."""
    return min(max(math.ceil(math.log2(WORLD_M / TILE_PX / resolution_m)), 0), DEEPEST_ZOOM)


def tile_png(folder: Path, stem: str, zoom: int, column: int, row: int) -> bytes:
    """PNG of the tile whose lower left corner is (column, row) times its side; unknown beyond the map.

    Raises:
        FileNotFoundError: the folder has no map ``stem``.
    """
    side_m = WORLD_M / 2**zoom
    with _lock:
        levels, finest_m, origin = _pyramid(folder, stem, identity(folder))
    halvings = max(math.floor(math.log2(side_m / TILE_PX / finest_m)), 0)
    pixels, resolution_m = levels[halvings], finest_m * 2**halvings
    canvas = np.full((TILE_PX, TILE_PX), PIXELS[Occupancy.UNKNOWN], np.uint8)
    # first and one past the last cell in the tile, per axis (x, y)
    corner = np.array((column, row)) * side_m - origin
    low = np.clip(np.floor(corner / resolution_m), 0, pixels.shape[::-1]).astype(int)
    high = np.clip(np.ceil((corner + side_m) / resolution_m), 0, pixels.shape[::-1]).astype(int)
    scale = TILE_PX / side_m
    left, bottom = np.rint((low * resolution_m - corner) * scale).astype(int)
    right, top = np.rint((high * resolution_m - corner) * scale).astype(int)
    if right > left and top > bottom:
        cells = pixels[low[1] : high[1], low[0] : high[0]]
        shrinks = cells.shape[0] > top - bottom
        drawn = cv2.resize(
            cells,
            (int(right - left), int(top - bottom)),
            interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_NEAREST,
        )
        inside = (slice(max(bottom, 0), min(top, TILE_PX)), slice(max(left, 0), min(right, TILE_PX)))
        canvas[inside] = drawn[
            inside[0].start - bottom : inside[0].stop - bottom, inside[1].start - left : inside[1].stop - left
        ]
    return bytes(cv2.imencode(".png", canvas[::-1])[1])


_lock = threading.Lock()
"""Many tiles are asked for at once: one request reads the map, the others wait for it."""


@lru_cache(MAPS_KEPT)
def _pyramid(
    folder: Path, stem: str, _version: tuple[int, int]
) -> tuple[list[NDArray[np.uint8]], float, NDArray[np.float64]]:
    """A map and coarser copies of it, so that a coarse tile of a large map reads few pixels.

    Pixels (H, W) with row 0 at the lowest y, half as many per side in each level as in the one before, their means;
    the resolution of the first level, and the lower left corner, shape (2,), in metres.
    """
    pgm, description = read_bytes(folder / f"{stem}.pgm", folder), read_text(folder / f"{stem}.yaml", folder)
    occupancy = parse_map(stem, pgm, description)
    levels = [pixels_of(occupancy.cells)]
    for _ in range(math.floor(math.log2(max(WORLD_M / TILE_PX / occupancy.resolution_m, 1.0)))):
        levels.append(_halved(levels[-1]))
    return levels, occupancy.resolution_m, np.array(occupancy.origin_xy)


def _halved(finer: NDArray[np.uint8]) -> NDArray[np.uint8]:
    height, width = finer.shape
    even = finer
    if height % 2 or width % 2:
        even = np.pad(finer, ((0, height % 2), (0, width % 2)), constant_values=PIXELS[Occupancy.UNKNOWN])
    coarser: NDArray[np.uint8] = cv2.resize(even, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
    return coarser
