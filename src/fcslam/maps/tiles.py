"""Square tiles of a map as pictures, for viewers that show parts of it."""

import math
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from fcslam.runs.folder import identity
from fcslam.runs.map_files import PIXELS, Occupancy, parse_map, pixels_of

WORLD_M = 512.0
"""Side of a tile at zoom 0; each zoom halves it."""
TILE_PX = 512
DEEPEST_ZOOM = 8


def finest_zoom(resolution_m: float) -> int:
    """The zoom whose pixels are no larger than cells; deeper ones show nothing more."""
    return min(max(math.ceil(math.log2(WORLD_M / TILE_PX / resolution_m)), 0), DEEPEST_ZOOM)


def tile_png(folder: Path, stem: str, zoom: int, column: int, row: int) -> bytes:
    """PNG of the tile whose lower left corner is (column, row) times its side; unknown beyond the map.

    Raises:
        FileNotFoundError: the folder has no map ``stem``.
    """
    version, side_m = identity(folder), WORLD_M / 2**zoom
    pixels, resolution_m, origin = _grid(folder, stem, version)
    halvings = max(math.floor(math.log2(side_m / TILE_PX / resolution_m)), 0)
    if halvings:
        pixels, resolution_m = _halved(folder, stem, version, halvings), resolution_m * 2**halvings
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
            cells, (int(right - left), int(top - bottom)),
            interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_NEAREST,
        )  # fmt: skip
        inside = (slice(max(bottom, 0), min(top, TILE_PX)), slice(max(left, 0), min(right, TILE_PX)))
        canvas[inside] = drawn[
            inside[0].start - bottom : inside[0].stop - bottom, inside[1].start - left : inside[1].stop - left
        ]
    return bytes(cv2.imencode(".png", canvas[::-1])[1])


@lru_cache(maxsize=32)
def _halved(folder: Path, stem: str, version: tuple[int, int], halvings: int) -> NDArray[np.uint8]:
    """The pixels, each the mean of 2^halvings x 2^halvings; a coarse tile of a large map then reads few."""
    finer = _halved(folder, stem, version, halvings - 1) if halvings > 1 else _grid(folder, stem, version)[0]
    height, width = finer.shape
    even = np.pad(finer, ((0, height % 2), (0, width % 2)), constant_values=PIXELS[Occupancy.UNKNOWN])
    halved: NDArray[np.uint8] = cv2.resize(even, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
    return halved


@lru_cache(maxsize=8)
def _grid(folder: Path, stem: str, _: tuple[int, int]) -> tuple[NDArray[np.uint8], float, NDArray[np.float64]]:
    """Pixels (H, W) with row 0 at the lowest y, resolution in metres, lower left corner (2,)."""
    pgm, description = (folder / f"{stem}.pgm").read_bytes(), (folder / f"{stem}.yaml").read_text(encoding="utf-8")
    occupancy = parse_map(stem, pgm, description)
    return pixels_of(occupancy.cells), occupancy.resolution_m, np.array(occupancy.origin_xy)
