"""Drawings in a finished map are tied to keyscans near them; the direction of walls is that of most of them."""

from dataclasses import replace

import numpy as np
import pytest

from fcslam.anchoring.walls import wall_direction
from fcslam.cloud.report import Track
from fcslam.errors import InputError
from fcslam.geometry import se2
from fcslam.maps.occupancy_map import Occupancy, OccupancyMap
from fcslam.mission.map_edits import moved_map, region_in_map
from fcslam.mission.mission_file import EMPTY
from fcslam.records import RegionUse, frozen
from fcslam.runs import RobotTrajectory, Run

SIDE_M = 0.05
WALL_DEG = 0.3
"""A wall of 12 m that turns by more reaches another cell."""
POSES = frozen([[0.0, 0.0, 0.0], [1.0, 0.0, 0.5], [2.0, 0.0, 1.0], [3.0, 0.0, 1.5]])
STAMPS = frozen([10.0, 11.0, 12.0, 13.0])
RUN = Run({"a": RobotTrajectory("a", 0, STAMPS, POSES), "b": RobotTrajectory("b", 1, STAMPS + 100.0, POSES)})
TRIANGLE = [(2.1, 1.0), (3.1, 1.0), (2.1, 2.0)]


def mission(*keyscans):
    """A mission in which these scans of a are keyscans, and the others 0.1 m from one."""
    offsets = np.zeros((4, 3))
    offsets[[k for k in range(4) if k not in keyscans], 0] = 0.1
    return replace(EMPTY, tracks={"a": Track(STAMPS, np.zeros(4, np.int64), frozen(offsets))})


def test_a_region_is_tied_to_the_nearest_keyscan_and_keeps_its_place():
    for keyscans, nearest in (((0, 1, 2, 3), 2), ((0, 1), 1)):
        region = region_in_map(RUN, mission(*keyscans), 0, RegionUse.AREA, "hall", TRIANGLE)
        assert (region.use, region.name) == (RegionUse.AREA, "hall")
        assert (region.session, region.stamp) == ("a", STAMPS[nearest])
        assert se2.transform(POSES[nearest], np.array(region.polygon)) == pytest.approx(np.array(TRIANGLE))


def test_a_region_is_tied_to_a_session_of_its_map():
    region = region_in_map(RUN, EMPTY, 1, RegionUse.ERASE, "", TRIANGLE)
    assert (region.session, region.stamp) == ("b", 112.0)


def test_a_motion_of_the_map_is_the_new_pose_of_one_of_its_keyscans():
    T = np.array((5.0, -1.0, 2.0))
    placement = moved_map(RUN, mission(1, 3), 0, T)
    assert (placement.session, placement.stamp) == ("a", 11.0)
    assert placement.pose == pytest.approx(se2.compose(T, POSES[1]))


def test_a_map_that_is_not_there_is_named():
    for ask in (
        lambda: region_in_map(RUN, EMPTY, 2, RegionUse.ERASE, "", TRIANGLE),
        lambda: moved_map(RUN, EMPTY, 2, np.zeros(3)),
    ):
        with pytest.raises(InputError, match="there is no map 2; there are 0, 1"):
            ask()
    nothing_seen = Run({"a": RobotTrajectory("a", 0, STAMPS[:0], POSES[:0])})
    with pytest.raises(InputError, match="there is no map 0; there are none"):
        moved_map(nothing_seen, EMPTY, 0, np.zeros(3))


def building(turned_rad):
    """Occupied cells of walls in two directions across each other, turned."""
    steps = np.arange(-6.0, 6.0, SIDE_M / 2)
    walls = [(steps, np.full(len(steps), offset)) for offset in (-4.0, -1.3, 2.2, 4.7)]
    walls += [(np.full(len(steps), offset), steps) for offset in (-5.1, 0.4, 3.9)]
    xy = se2.transform(np.array((0.0, 0.0, turned_rad)), np.concatenate([np.column_stack(wall) for wall in walls]))
    cells = np.zeros((400, 400), np.uint8)
    columns, rows = np.floor(xy.T / SIDE_M).astype(int) + 200
    cells[rows, columns] = Occupancy.OCCUPIED
    return OccupancyMap(cells, SIDE_M, (-10.0, -10.0))


@pytest.mark.parametrize("degrees", [0.0, 0.3, 7.3, 29.9, -18.2, 44.0, -44.0])
def test_the_direction_of_walls(degrees):
    assert np.degrees(wall_direction(building(np.radians(degrees)))) == pytest.approx(degrees, abs=WALL_DEG)


def test_walls_at_45_degrees_are_turned_either_way():
    assert abs(np.degrees(wall_direction(building(np.pi / 4)))) == pytest.approx(45.0, abs=0.3)


def test_a_map_without_walls_has_no_direction():
    assert wall_direction(OccupancyMap(np.zeros((5, 5), np.uint8), SIDE_M, (0.0, 0.0))) == 0.0
