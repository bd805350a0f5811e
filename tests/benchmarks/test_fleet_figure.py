"""The figure of a fleet: what is drawn where. Whether it is beautiful is for people to judge."""

import numpy as np
import pytest
from evaluation.fleet_charts import fleet_charts
from evaluation.fleet_figure import (
    Chart,
    FleetCharts,
    MatchedPlaces,
    draw_figure,
    spread,
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


def sheet(charts):
    (axes,) = draw_figure(charts).axes
    return axes


def match_lines(charts):
    return [line for line in sheet(charts).lines if line.get_gid() == "match"]


def pixel(axes, panel, x, y):
    """Where the image of a hall, which fills the unit square before its own transform, says that a point is."""
    transform = axes.images[panel].get_transform() - axes.transData
    return transform.transform(np.array((x, y)) / SIZE_M)


def test_every_way_lies_on_its_map(charts):
    axes = sheet(charts)
    assert len(axes.images) == len(ROBOTS) + 2
    for k, color in enumerate(palette.ROBOTS[: len(ROBOTS)]):
        drawn = [line.get_xydata() for line in axes.lines if line.get_color() == f"#{color:06X}"]
        drawn = [line for line in drawn if len(line) == 2]
        own, fused, building = drawn
        for line, panel, y in ((own, k, 1.0), (fused, 3, 1.0 + 0.5 * k), (building, 4, 1.0 + 0.5 * k)):
            np.testing.assert_allclose(line, [pixel(axes, panel, x, y) for x in (1.0, 5.0)])


def test_a_line_leads_from_place_to_place_in_the_color_of_its_channel(charts):
    axes = sheet(charts)
    lines = match_lines(charts)
    assert [line.get_color() for line in lines] == [LIDAR, LIDAR, LIDAR, CAMERA]
    for line, (i, j) in zip(lines, ((0, 1), (1, 2), (0, 2), (0, 1)), strict=True):
        ends = line.get_xydata()[[0, -1]]
        np.testing.assert_allclose(ends, [pixel(axes, i, 1.0, 1.0), pixel(axes, j, 2.0, 2.0)])


def test_few_of_many_matches_lie_far_apart():
    crowd = [match(0, 1, x=1.0 + 0.001 * k) for k in range(50)] + [match(0, 1, x=4.0), match(0, 2, x=4.0)]
    assert [(m.robot_j, float(m.xy_i[0])) for m in spread(crowd, 2)] == [("b", 1.0), ("b", 4.0), ("c", 4.0)]
    assert len(spread(crowd, 1000)) == len(crowd)


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
