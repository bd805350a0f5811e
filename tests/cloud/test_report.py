"""The run of a result: which files it has."""

import pytest

from fcslam.cloud.report import LEAST_DRAWN, keyscan_track, run_of
from fcslam.lidar.occupancy import OccupancyConfig
from tests.scripted import rectangle, stream
from tests.small_fleet import feed

POSES = rectangle()
FILES = {"map.pgm", "map.yaml", "map.png", "map_1.pgm", "map_1.yaml"}


@pytest.mark.parametrize(("keyscans", "more"), [(LEAST_DRAWN - 1, set()), (LEAST_DRAWN, {"map_1.png"})])
def test_of_the_smaller_maps_those_of_a_few_keyscans_get_no_picture(scripted, keyscans, more):
    packets = [*stream("a", POSES, start_s=0.0), *stream("b", POSES[:keyscans], start_s=0.0)]
    result = feed(scripted(), packets).finalize()
    tracks = {robot.robot: keyscan_track(robot) for robot in result.robots}
    assert set(run_of(result, tracks, [], "", OccupancyConfig()).map_files) == FILES | more


def test_the_largest_map_has_a_picture_however_small_it_is(scripted):
    result = feed(scripted(), stream("a", POSES[:1], start_s=0.0)).finalize()
    tracks = {robot.robot: keyscan_track(robot) for robot in result.robots}
    assert set(run_of(result, tracks, [], "", OccupancyConfig()).map_files) == {"map.pgm", "map.yaml", "map.png"}
