"""Regions in the files of a map: which cells they cover, and what other programs read."""

import json
from dataclasses import replace

import numpy as np
import pytest

from fcslam.cloud.placement import PlacedRegion, region_files, with_regions
from fcslam.maps.occupancy_map import Occupancy, OccupancyMap, parse_map
from fcslam.records import RegionUse

SIDE_M = 0.1
CELLS = np.tile(np.array([Occupancy.FREE, Occupancy.OCCUPIED], np.uint8), (40, 30))
MAP = OccupancyMap(CELLS, SIDE_M, (-2.0, -1.0))
TRIANGLE = [(-1.03, -0.52), (1.48, -0.41), (0.27, 1.93)]
L_SHAPE = [(0.02, 0.03), (2.04, 0.03), (2.04, 0.56), (0.57, 0.56), (0.57, 1.98), (0.02, 1.98)]


def region(use, corners, name=""):
    return PlacedRegion(use, name, 0, np.array(corners, dtype=np.float64))


def is_inside(corners, x, y):
    """By the number of sides that a ray to the right crosses."""
    sides = zip(corners, [*corners[1:], corners[0]], strict=True)
    return sum((y0 > y) != (y1 > y) and x < x0 + (y - y0) * (x1 - x0) / (y1 - y0) for (x0, y0), (x1, y1) in sides) % 2


@pytest.mark.parametrize("corners", [TRIANGLE, TRIANGLE[::-1], L_SHAPE], ids=["triangle", "clockwise", "L"])
def test_an_erased_region_covers_the_cells_with_their_centre_inside_and_at_most_those_at_its_edge(corners):
    changed = with_regions(MAP, [region(RegionUse.ERASE, corners)]).cells != MAP.cells
    height, width = MAP.cells.shape
    xs, ys = (MAP.origin_xy[axis] + (np.arange(n) + 0.5) * SIDE_M for axis, n in ((0, width), (1, height)))
    inside = np.array([[is_inside(corners, x, y) for x in xs] for y in ys], dtype=bool)
    assert changed[inside].all()
    grown = np.pad(inside, 1)
    near = np.any([grown[i : i + height, j : j + width] for i in range(3) for j in range(3)], axis=0)
    assert not changed[~near].any()


def test_a_region_may_be_larger_than_the_map_or_beside_it():
    all_of_it = [(-1e5, -1e5), (1e5, -1e5), (1e5, 1e5), (-1e5, 1e5)]
    assert (with_regions(MAP, [region(RegionUse.ERASE, all_of_it)]).cells == Occupancy.UNKNOWN).all()
    beside = [(90.0, 0.0), (91.0, 0.0), (90.0, 1.0)]
    assert with_regions(MAP, [region(RegionUse.ERASE, beside)]).cells.tobytes() == MAP.cells.tobytes()


@pytest.mark.parametrize("side_m", [0.05, 0.002, 0.001])
@pytest.mark.parametrize("far_m", [1e2, 1e4, 1e5])
def test_a_corner_far_away_moves_no_edge(side_m, far_m):
    """The region is right of a slanted line through the middle of the map."""
    fine = replace(MAP, resolution_m=side_m, origin_xy=(-30 * side_m, -20 * side_m))
    slope = 0.3
    corners = [(-slope * far_m, -far_m), (far_m, -far_m), (far_m, far_m), (slope * far_m, far_m)]
    changed = with_regions(fine, [region(RegionUse.ERASE, corners)]).cells != fine.cells
    y, x = ((np.arange(count) + 0.5 - count / 2.0) for count in fine.cells.shape)
    right_of_it = x[None] - slope * y[:, None]
    assert changed[right_of_it > 0.1].all()
    assert not changed[right_of_it < -1.0].any()


def test_a_far_part_of_a_region_in_two_pieces_covers_nothing_between_them():
    """A U that is open to the right, with its bottom a kilometre to the left: two bars cross the map."""
    bars = [(-1e5, -0.8), (1e5, -0.8), (1e5, -0.3), (-1e3, -0.3), (-1e3, 1.0), (1e5, 1.0), (1e5, 1.5), (-1e5, 1.5)]
    changed = with_regions(MAP, [region(RegionUse.ERASE, bars)]).cells != MAP.cells
    y = MAP.origin_xy[1] + (np.arange(len(changed)) + 0.5) * SIDE_M
    covered = ((y > -0.8) & (y < -0.3)) | ((y > 1.0) & (y < 1.5))
    assert changed[covered].all()
    assert not changed[np.abs(y - 0.35) < 0.5].any()


def test_a_freed_region_is_free_and_of_two_regions_the_later_one_counts():
    both = [region(RegionUse.ERASE, TRIANGLE), region(RegionUse.FREE, TRIANGLE)]
    inside = with_regions(MAP, both[:1]).cells == Occupancy.UNKNOWN
    for regions, becomes in ((both, Occupancy.FREE), (both[::-1], Occupancy.UNKNOWN)):
        cells = with_regions(MAP, regions).cells
        assert (cells[inside] == becomes).all()
        assert np.array_equal(cells[~inside], MAP.cells[~inside])


def test_the_mask_of_nav2_has_the_cells_of_the_map():
    files = region_files(MAP, "map_1", [region(RegionUse.KEEP_OUT, TRIANGLE), region(RegionUse.KEEP_OUT, L_SHAPE)])
    assert sorted(files) == ["map_1_keepout.pgm", "map_1_keepout.yaml"]
    mask = parse_map("mask", files["map_1_keepout.pgm"], files["map_1_keepout.yaml"].decode())
    assert b"image: map_1_keepout.pgm" in files["map_1_keepout.yaml"]
    assert (mask.resolution_m, mask.origin_xy, mask.cells.shape) == (SIDE_M, MAP.origin_xy, MAP.cells.shape)
    covered = (
        with_regions(MAP, [region(RegionUse.ERASE, corners) for corners in (TRIANGLE, L_SHAPE)]).cells != MAP.cells
    )
    assert np.array_equal(mask.cells, np.where(covered, Occupancy.OCCUPIED, Occupancy.FREE))


def test_areas_are_closed_rings_in_metres():
    files = region_files(MAP, "map", [region(RegionUse.AREA, TRIANGLE, "Küche"), region(RegionUse.AREA, L_SHAPE, "L")])
    assert list(files) == ["map_areas.geojson"]
    content = json.loads(files["map_areas.geojson"])
    assert content["type"] == "FeatureCollection"
    first, second = content["features"]
    assert (first["properties"], second["properties"]["name"]) == ({"name": "Küche", "map": 0}, "L")
    (ring,) = first["geometry"]["coordinates"]
    assert ring == [*map(list, TRIANGLE), list(TRIANGLE[0])]


def test_only_an_erasure_erases_and_it_needs_no_file():
    for use in (RegionUse.AREA, RegionUse.KEEP_OUT):
        assert with_regions(MAP, [region(use, TRIANGLE)]) is MAP
    assert region_files(MAP, "map", []) == region_files(MAP, "map", [region(RegionUse.ERASE, TRIANGLE)]) == {}
