"""Tiles of a map: every zoom shows the same map, however large it is."""

from concurrent.futures import ThreadPoolExecutor

import cv2
import numpy as np
import pytest

from fcslam.maps.occupancy_map import PIXELS, Occupancy, OccupancyMap, map_yaml, pgm_bytes
from fcslam.maps.tiles import TILE_PX, WORLD_M, finest_zoom, tile_png

RESOLUTION_M = 0.05
ORIGIN = (-13.7, 4.05)


@pytest.fixture
def grid(tmp_path):
    """A map of random blocks, 90 m by 60 m, in a run folder."""
    rng = np.random.default_rng(0)
    blocks = rng.choice([Occupancy.FREE, Occupancy.OCCUPIED, Occupancy.UNKNOWN], (41, 61))
    cells = np.kron(blocks, np.ones((30, 30))).astype(np.uint8)[:1201, :1803]
    occupancy = OccupancyMap(cells, RESOLUTION_M, ORIGIN)
    (tmp_path / "map.pgm").write_bytes(pgm_bytes(occupancy))
    (tmp_path / "map.yaml").write_text(map_yaml(occupancy, "map.pgm"))
    return occupancy


def drawn(folder, zoom, column, row):
    """Pixels of a tile, row 0 at the lowest y."""
    png = np.frombuffer(tile_png(folder, "map", zoom, column, row), np.uint8)
    return cv2.imdecode(png, cv2.IMREAD_GRAYSCALE)[::-1].astype(float)


def expected(grid, zoom, column, row):
    """The same by looking every point of the tile up, at 4 x 4 points in each pixel."""
    side_m, points = WORLD_M / 2**zoom, 4 * TILE_PX
    pixel_of = np.array([PIXELS[state] for state in sorted(PIXELS)])
    at = [np.floor((side_m * (first + (np.arange(points) + 0.5) / points) - corner) / RESOLUTION_M).astype(int)
          for first, corner in zip((column, row), grid.origin_xy, strict=True)]  # fmt: skip
    inside = [(index >= 0) & (index < size) for index, size in zip(at, grid.cells.shape[::-1], strict=True)]
    looked_up = pixel_of[grid.cells[np.ix_(at[1] * inside[1], at[0] * inside[0])]].astype(float)
    looked_up[~np.outer(inside[1], inside[0])] = PIXELS[Occupancy.UNKNOWN]
    return looked_up.reshape(TILE_PX, 4, TILE_PX, 4).mean((1, 3))


@pytest.mark.slow
@pytest.mark.parametrize("zoom", range(6))
def test_every_zoom_shows_the_map(grid, tmp_path, zoom):
    side_m = WORLD_M / 2**zoom
    column, row = (int(np.floor((corner + 25.0) / side_m)) for corner in ORIGIN)
    off = np.abs(drawn(tmp_path, zoom, column, row) - expected(grid, zoom, column, row))
    # A block has 30 cells: where two of them meet, a pixel may fall to either.
    assert np.percentile(off, 60) <= 1.0
    assert off.mean() < 12.0


def test_no_zoom_is_finer_than_the_cells():
    assert WORLD_M / TILE_PX / 2 ** finest_zoom(RESOLUTION_M) <= RESOLUTION_M


@pytest.mark.usefixtures("grid")
def test_many_requests_at_once_get_what_each_gets_alone(tmp_path):
    with ThreadPoolExecutor(8) as pool:
        at_once = list(pool.map(lambda column: tile_png(tmp_path, "map", 4, column, 0), range(8)))
    assert at_once == [tile_png(tmp_path, "map", 4, column, 0) for column in range(8)]
