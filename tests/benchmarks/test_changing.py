"""Buildings that change between robots."""

import numpy as np
import pytest
from worlds.changing import ChangingBuilding, close_doors

from fcslam.lab.simulation.noise import LidarSettings
from fcslam.lab.simulation.options import Building
from fcslam.lab.simulation.simulated_fleet import SimulationSettings, simulate_fleet

pytestmark = pytest.mark.slow

SETTINGS = SimulationSettings(
    building=Building.FLAT,
    robots=3,
    path_length_m=12.0,
    camera=None,
    moved_furniture=0.5,
    lidar=LidarSettings(beams=60),
)


def moved_pieces(before, after):
    pairs = zip(before.plan.pieces, after.plan.pieces, strict=True)
    return sum(not np.array_equal(a.outline, b.outline) for a, b in pairs)


@pytest.fixture(scope="module")
def robots():
    return simulate_fleet(SETTINGS, 1, ChangingBuilding(SETTINGS.building)).robots


def test_changes_are_found_by_later_robots(robots):
    first, second, third = robots
    assert moved_pieces(first, second) > 0
    assert moved_pieces(first, third) > moved_pieces(second, third)


def test_closed_doors_are_on_no_way(robots):
    for robot, open_ in zip(close_doors(robots, 1.0), robots, strict=True):
        closed = robot.plan.pieces[len(open_.plan.pieces) :]
        assert closed
        for door in closed:
            assert np.linalg.norm(robot.T_building_base[:, :2] - door.centre, axis=1).min() > 0.9
