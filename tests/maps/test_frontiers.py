"""Frontiers of drawn maps, whose places and path lengths are known."""

import numpy as np
import pytest

from fcslam.maps.exploration import Explorer
from fcslam.maps.frontiers import Frontier, frontiers
from fcslam.maps.occupancy_map import Occupancy, OccupancyMap

SIDE_M = 0.1


def drawn(width_m, height_m, *openings):
    """A walled room with the origin in its lower left corner; in each opening (x, y from, y to), there is no wall."""
    cells = np.full((round(height_m / SIDE_M), round(width_m / SIDE_M)), Occupancy.FREE, np.uint8)
    cells[:, 0] = cells[:, -1] = cells[0] = cells[-1] = Occupancy.OCCUPIED
    for x, low, high in openings:
        cells[round(low / SIDE_M) : round(high / SIDE_M), min(round(x / SIDE_M), cells.shape[1] - 1)] = Occupancy.FREE
    return OccupancyMap(cells, SIDE_M, (0.0, 0.0))


def test_a_closed_room_has_no_frontier():
    assert frontiers(drawn(6, 4), np.array([[3.0, 2.0]]), 0.3) == []


def test_a_gap_in_the_wall_is_a_frontier_with_its_length_and_its_distance():
    (found,) = frontiers(drawn(6, 4, (6, 1, 3)), np.array([[1.05, 2.05], [4.05, 2.05]]), 0.3)
    assert found.length_m == pytest.approx(2.0, abs=0.11)
    assert found.point == pytest.approx((5.95, 2.0), abs=0.11)
    assert found.distances_m == pytest.approx((4.9, 1.9), abs=0.15)


@pytest.mark.parametrize(("radius_m", "count"), [(0.3, 1), (0.6, 0)])
def test_a_gap_counts_only_for_a_robot_that_fits(radius_m, count):
    occupancy = drawn(6, 4, (6, 1.5, 2.5))
    assert len(frontiers(occupancy, np.array([[3.0, 2.0]]), radius_m)) == count


def test_a_robot_behind_a_wall_has_no_path():
    occupancy = drawn(6, 4, (6, 1, 3))
    occupancy.cells[:, 30] = Occupancy.OCCUPIED
    (found,) = frontiers(occupancy, np.array([[1.0, 2.0], [5.0, 2.0]]), 0.3)
    assert np.isinf(found.distances_m[0])
    assert np.isfinite(found.distances_m[1])
    assert frontiers(occupancy, np.array([[1.0, 2.0]]), 0.3) == []


def test_the_path_leads_around_walls():
    occupancy = drawn(6, 4, (6, 1, 3))
    occupancy.cells[:30, 30] = Occupancy.OCCUPIED
    (found,) = frontiers(occupancy, np.array([[1.0, 1.0]]), 0.2)
    assert found.distances_m[0] > np.hypot(2.0, 2.2) + np.hypot(2.9, 1.2) - 0.1


def test_resolution_and_origin_do_not_matter():
    coarse = drawn(6, 4, (6, 1, 3))
    fine = OccupancyMap(np.kron(coarse.cells, np.ones((2, 2), np.uint8)), SIDE_M / 2, (10.0, -5.0))
    (here,) = frontiers(coarse, np.array([[1.05, 2.05]]), 0.3)
    (there,) = frontiers(fine, np.array([[11.05, -2.95]]), 0.3)
    assert np.subtract(there.point, (10.0, -5.0)) == pytest.approx(here.point)
    assert there.distances_m == pytest.approx(here.distances_m)


def test_an_empty_map_and_a_map_without_robots_have_no_frontier():
    assert frontiers(OccupancyMap(np.zeros((9, 9), np.uint8), 0.05, (0.0, 0.0)), np.zeros((1, 2)), 0.3) == []
    assert frontiers(drawn(6, 4, (6, 1, 3)), np.zeros((0, 2)), 0.3) == []


def gaps(*rows):
    """Frontiers two metres apart, with a distance for each robot."""
    return [Frontier((2.0 * number, 0.0), 1.0, 5.0, row) for number, row in enumerate(rows)]


def test_the_sum_of_all_paths_is_least():
    # Robot a is nearer to both; if it took its nearest one, b would have to drive 9 m.
    found = gaps((1.0, 2.0), (2.0, 9.0))
    goals = Explorer().assign(found, {"a": (0.0, 9.0), "b": (0.0, 9.0)})
    assert {robot: found.index(goal) for robot, goal in goals.items()} == {"a": 1, "b": 0}


def test_a_larger_unknown_area_is_worth_a_longer_path():
    found = [Frontier((0.0, 0.0), 1.0, 1.0, (2.0,)), Frontier((9.0, 0.0), 1.0, 20.0, (5.0,))]
    assert Explorer().assign(found, {"a": (0.0, 5.0)}) == {"a": found[1]}


def test_a_robot_keeps_its_goal_unless_another_one_saves_much():
    explorer, robots = Explorer(), {"a": (0.0, 9.0)}
    assert explorer.assign(gaps((4.0,), (5.0,)), robots)["a"].point[0] == 0.0
    assert explorer.assign(gaps((5.0,), (4.0,)), robots)["a"].point[0] == 0.0
    assert explorer.assign(gaps((9.0,), (4.0,)), robots)["a"].point[0] == 2.0


def test_a_frontier_that_stays_after_a_robot_was_there_is_no_goal_again():
    explorer, found = Explorer(), gaps((4.0,), (5.0,))
    assert explorer.assign(found, {"a": (0.0, 4.0)}) == {"a": found[0]}
    for at in ((0.0, 0.1), (0.0, 4.0)):
        assert explorer.assign(found, {"a": at}) == {"a": found[1]}


def test_more_robots_than_frontiers_share_them_and_no_path_is_no_goal():
    found = gaps((4.0, 5.0, np.inf))
    robots = {"a": (0.0, 9.0), "b": (0.0, 9.0), "c": (0.0, 9.0)}
    assert Explorer().assign(found, robots) == {"a": found[0], "b": found[0]}
    assert Explorer().assign([], robots) == {}
    assert Explorer().assign(found[:0], {}) == {}
