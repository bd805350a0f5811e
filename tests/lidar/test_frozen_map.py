"""A finished map as surfaces and free space: where its walls are, which side is free, and what cannot be used."""

import numpy as np
import pytest

from fcslam.errors import SourceError
from fcslam.lidar.frozen_map import frozen_map
from fcslam.lidar.submap import agreement
from fcslam.maps.occupancy_map import Occupancy, OccupancyMap

CORNER = (-3.0, 5.0)


def room(side_m=0.05, width_m=8.0, depth_m=6.0):
    """A room with walls one cell thick and unknown area around it; its lower left inner corner is at CORNER + 1 m."""
    rows, columns = (round((extent + 2.0) / side_m) for extent in (depth_m, width_m))
    cells = np.full((rows, columns), Occupancy.UNKNOWN, np.uint8)
    edge = round(1.0 / side_m)
    cells[edge - 1 : rows - edge + 1, edge - 1 : columns - edge + 1] = Occupancy.OCCUPIED
    cells[edge : rows - edge, edge : columns - edge] = Occupancy.FREE
    return OccupancyMap(cells, side_m, CORNER)


@pytest.mark.parametrize("side_m", [0.025, 0.05, 0.1, 0.2])
def test_walls_are_where_the_map_has_them_and_face_the_free_side(side_m):
    surface = frozen_map(room(side_m), "room").surface
    x, y = surface.points.T
    left, right, low, high = CORNER[0] + 1.0, CORNER[0] + 9.0, CORNER[1] + 1.0, CORNER[1] + 7.0
    off = np.min([np.abs(x - left), np.abs(x - right), np.abs(y - low), np.abs(y - high)], axis=0)
    assert off.max() <= side_m
    inwards = np.array((0.5 * (left + right), 0.5 * (low + high))) - surface.points
    assert (np.einsum("na,na->n", surface.normals, inwards) > 0.0).all()
    middle = (np.abs(x - left) < side_m) & (np.abs(y - 0.5 * (low + high)) < 1.0)
    assert np.allclose(surface.normals[middle], (1.0, 0.0), atol=0.05)


@pytest.mark.parametrize("side_m", [0.025, 0.05, 0.07, 0.1, 0.2])
def test_a_map_agrees_with_itself_and_not_with_itself_moved(side_m):
    frozen = frozen_map(room(side_m), "room")
    same = agreement(frozen, frozen, np.zeros(3))
    assert same.explained == 1.0
    assert same.overlap == 1.0
    moved = agreement(frozen, frozen, np.array((1.0, 1.0, 0.3)))
    assert moved.violation > 0.3


def test_free_space_is_where_the_map_is_free():
    found = frozen_map(room(0.07), "room")
    area = found.free.sum() * 0.01
    assert area == pytest.approx(8.0 * 6.0, rel=0.05)
    assert np.allclose(found.free_corner, CORNER)


def test_what_cannot_be_used_is_told():
    empty = OccupancyMap(np.full((50, 50), Occupancy.UNKNOWN, np.uint8), 0.05, (0.0, 0.0))
    with pytest.raises(SourceError, match="hall: shows no wall beside free space"):
        frozen_map(empty, "hall")
    with pytest.raises(SourceError, match=r"hall: cells of 0.5 m are too coarse"):
        frozen_map(room(0.5), "hall")
    with pytest.raises(SourceError, match=r"hall: extends over 500 m"):
        frozen_map(room(0.25, width_m=500.0), "hall")
