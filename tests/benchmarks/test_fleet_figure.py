"""The figure of a fleet: what is drawn where. Whether it is beautiful is for people to judge."""

import numpy as np
import pytest
from evaluation.fleet_charts import fleet_charts
from evaluation.fleet_figure import (
    Chart,
    FleetCharts,
    MatchedPlaces,
    write_figure,
)

from fcslam.errors import InputError
from fcslam.geometry import se2
from fcslam.maps import palette
from fcslam.metrics.grid import LabelledGrid
from fcslam.records import Channel, ClosureStatus, Reason, ReasonCode
from fcslam.runs import ClosureRow, LocalMap, RobotTrajectory, Run, write_tum

pytestmark = pytest.mark.slow

SIDE_M = 0.05
SIZE_M = np.array((6.0, 4.0))
ROBOTS = ("a", "b", "c")
LIDAR, CAMERA = (f"#{palette.CLOSURES[channel]:06X}" for channel in (Channel.LIDAR, Channel.CAMERA))


def hall():
    """A free hall with walls one cell thick, its corner in the origin."""
    columns, rows = np.rint(SIZE_M / SIDE_M).astype(int)
    free = np.zeros((rows, columns), np.bool_)
    free[1:-1, 1:-1] = True
    return LabelledGrid(~free, free, SIDE_M, np.zeros(3))


def way(k=0):
    return np.array([(1.0, 1.0 + 0.5 * k, 0.0), (5.0, 1.0 + 0.5 * k, 0.0)])


def match(i, j, channel=Channel.LIDAR, x=1.0, accepted=True):
    return MatchedPlaces(ROBOTS[i], np.array((x, 1.0)), ROBOTS[j], np.array((x + 1.0, 2.0)), channel, accepted)


@pytest.fixture
def charts():
    trajectories = {robot: way(k) for k, robot in enumerate(ROBOTS)}
    return FleetCharts(
        {robot: Chart(hall(), {robot: way()}) for robot in ROBOTS},
        Chart(hall(), trajectories, (1.0, 2.0, 0.7)),
        Chart(hall(), trajectories),
        [match(0, 1), match(1, 2), match(0, 2), match(0, 1, Channel.CAMERA)],
    )


def test_the_same_charts_make_the_same_file(charts, tmp_path):
    for name in ("one.png", "two.png"):
        write_figure(charts, tmp_path / name)
    assert (tmp_path / "one.png").read_bytes() == (tmp_path / "two.png").read_bytes()
    with pytest.raises(InputError, match="cannot be written"):
        write_figure(charts, tmp_path / "missing" / "figure.png")


PGM = b"P5\n2 1\n255\n" + bytes((254, 0))
YAML = """image: {}.pgm
mode: trinary
resolution: 0.5
origin: [0.0, 0.0, 0.0]
negate: 0
occupied_thresh: 0.65
free_thresh: 0.196
"""
T_BUILDING_MAP = np.array((3.0, -1.0, 1.0))


@pytest.fixture
def run_folder(tmp_path):
    """Robots a and b in one map, c alone; the truth of all of them beside it."""
    stamps = np.array((10.0, 11.0, 12.0))
    poses = {robot: np.array([(x, float(k), 0.0) for x in (0.0, 1.0, 2.0)]) for k, robot in enumerate(ROBOTS)}
    trajectories = {robot: RobotTrajectory(robot, k // 2, stamps, poses[robot]) for k, robot in enumerate(ROBOTS)}
    own = {robot: LocalMap(robot, stamps, poses[robot] - poses[robot][0], PGM, YAML.format(robot)) for robot in ROBOTS}
    closures = [
        ClosureRow(i, 11.0, j, 12.0, Channel.CAMERA, 0.5, np.zeros(3), status, Reason(ReasonCode.VERIFIED))
        for i, j, status in (("b", "a", "accepted"), ("a", "a", "accepted"), ("a", "b", "rejected"))
        for status in [ClosureStatus(status)]
    ]
    files = {"map.pgm": PGM, "map.yaml": YAML.format("map").encode()}
    Run(trajectories, tuple(closures), map_files=files, local_maps=own).save(tmp_path / "run")
    truth = tmp_path / "recordings" / "ground_truth"
    truth.mkdir(parents=True)
    (truth / "map.pgm").write_bytes(PGM)
    (truth / "map.yaml").write_text(YAML.format("map"))
    for robot in ROBOTS:
        write_tum(tmp_path / "recordings" / f"{robot}.tum", stamps, se2.compose(T_BUILDING_MAP, poses[robot]))
    return tmp_path / "run"


def test_charts_of_a_run_folder(run_folder):
    charts = fleet_charts(run_folder)
    assert list(charts.local) == list(charts.building.trajectories) == list(ROBOTS)
    assert list(charts.fused.trajectories) == ["a", "b"]
    np.testing.assert_allclose(charts.fused.T_chart_map, T_BUILDING_MAP, atol=1e-6)
    np.testing.assert_allclose(
        charts.fused.place(charts.fused.trajectories["b"]), charts.building.trajectories["b"][:, :2], atol=1e-6
    )
    ((robot_i, xy_i, robot_j, xy_j, channel, accepted),) = charts.matches
    assert (robot_i, robot_j, channel, accepted) == ("a", "b", Channel.CAMERA, True)
    np.testing.assert_allclose((xy_i, xy_j), [(2.0, 0.0), (1.0, 0.0)])
