"""The run of a result: which files it has."""

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
from evaluation.g2o_files import read_g2o

from fcslam.cloud.report import LEAST_DRAWN, keyscan_track, run_of
from fcslam.lidar.occupancy import OccupancyConfig
from fcslam.records import ClosureStatus
from fcslam.runs import open_run
from tests.scripted import closures, rectangle, stream
from tests.small_fleet import feed, in_order

POSES = rectangle()
FIRST, SECOND = {"map.pgm", "map.yaml", "map.png"}, {"map_1.pgm", "map_1.yaml"}


@pytest.mark.parametrize(
    ("keyscans", "files"),
    [
        ((61, LEAST_DRAWN - 1), FIRST | SECOND), ((61, LEAST_DRAWN), FIRST | SECOND | {"map_1.png"}), ((1, 0), FIRST),
    ],
)  # fmt: skip
def test_maps_have_a_picture_but_smaller_ones_of_few_keyscans(scripted, keyscans, files):
    packets = [p for robot, n in zip("ab", keyscans, strict=True) if n for p in stream(robot, POSES[:n], start_s=0.0)]
    result = feed(scripted(), packets).finalize()
    tracks = {robot.robot: keyscan_track(robot) for robot in result.robots}
    assert set(run_of(result, tracks, [], "", OccupancyConfig()).map_files) == files


def test_the_pose_graph_of_two_robots_comes_back_with_its_odometry_and_closures(scripted, tmp_path):
    """Their packets arrive by turns, so the cloud's own numbers go back and forth between the two."""
    script = closures(("a", POSES), ("b", POSES), [(k, k) for k in (0, 8, 16, 24, 32, 40)])
    (unlike,) = (replace(line, passes=False) for line in closures(("a", POSES), ("b", POSES), [(4, 4)]))
    packets = in_order([*stream("a", POSES, start_s=0.0), *stream("b", POSES, start_s=0.5)])
    result = feed(scripted(script, [unlike]), packets).finalize()
    tracks = {name: keyscan_track(robot) for name in "ba" for robot in result.robots if robot.robot == name}
    run_of(result, tracks, [], "", OccupancyConfig()).save(tmp_path / "run")
    statuses = Counter(closure.status for closure in open_run(tmp_path / "run").closures)
    assert statuses == {ClosureStatus.ACCEPTED: len(script), ClosureStatus.CANDIDATE: 1}
    back = read_g2o(tmp_path / "run" / "pose_graph.g2o")
    assert [edge.robust for edge in back.graph.edges] == [edge.robust for edge in result.graph.edges]
    assert sum(edge.robust for edge in back.graph.edges) == len(script)
    count = len(POSES)
    assert back.ids == (*range(count), *range(count + 1, 2 * count + 1)), "one id between two robots is unused"
    written = {robot.robot: robot.T_map_base for robot in result.robots}
    assert np.array_equal(back.graph.poses(), np.concatenate([written[name] for name in sorted(tracks)]))
