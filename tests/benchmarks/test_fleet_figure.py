"""The figure of a fleet: what is drawn where. Whether it is beautiful is for people to judge."""

from dataclasses import replace
from itertools import combinations

import cv2
import numpy as np
import pytest
from evaluation.fleet_charts import fleet_charts
from evaluation.fleet_figure import (
    MATCHES_DRAWN,
    RAY_M,
    WIDTH_PX,
    Chart,
    FleetCharts,
    MatchedPlaces,
    draw_figure,
    spread,
    write_figure,
)

from fcslam.errors import EvaluationError, OutputError
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


def texts(charts):
    return {text.get_text() for text in sheet(charts).texts}


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


def test_the_fused_map_is_turned_onto_the_building_and_local_maps_are_as_they_are(charts):
    axes = sheet(charts)
    angles = [np.arctan2(*(pixel(axes, panel, 6, 0) - pixel(axes, panel, 0, 0))[::-1]) for panel in range(5)]
    np.testing.assert_allclose(angles, [0.0, 0.0, 0.0, 0.7, 0.0], atol=1e-9)


def test_charts_stay_on_the_sheet_and_apart(charts):
    axes = sheet(charts)
    corners = [np.array([pixel(axes, k, x, y) for x in (0, 6) for y in (0, 4)]) for k in range(5)]
    boxes = [(box.min(axis=0), box.max(axis=0)) for box in corners]
    for k, (low, high) in enumerate(boxes):
        assert (low > 0).all()
        assert high[0] < WIDTH_PX
        assert high[1] < axes.get_ylim()[1]
        assert all((high < other).any() or (low > beyond).any() for other, beyond in boxes[:k])


def test_a_line_leads_from_place_to_place_in_the_color_of_its_channel(charts):
    axes = sheet(charts)
    lines = match_lines(charts)
    assert [line.get_color() for line in lines] == [LIDAR, LIDAR, LIDAR, CAMERA]
    for line, (i, j) in zip(lines, ((0, 1), (1, 2), (0, 2), (0, 1)), strict=True):
        ends = line.get_xydata()[[0, -1]]
        np.testing.assert_allclose(ends, [pixel(axes, i, 1.0, 1.0), pixel(axes, j, 2.0, 2.0)])


def test_a_line_over_a_chart_rises_and_others_are_straight(charts):
    rises = []
    for line in match_lines(charts):
        points = line.get_xydata()
        straight = np.linspace(points[0], points[-1], len(points))
        rises.append((points - straight)[:, 1].max())
    assert [rise > 1.0 for rise in rises] == [False, False, True, False]


def test_every_match_that_is_not_accepted_is_a_line_of_its_own_color(charts):
    many = [match(0, 1, x=1.0 + 0.1 * k, accepted=False) for k in range(2 * MATCHES_DRAWN)]
    shown = replace(charts, matches=[match(0, 1), *many])
    lines = [line for line in sheet(shown).lines if line.get_gid() == "unused"]
    assert len(lines) == len(many)
    assert LIDAR not in {line.get_color() for line in lines}
    assert {"recognised by LiDAR: 1 closure", f"matched, not accepted: {len(many)}"} <= texts(shown)


def test_closures_are_counted_by_channel(charts):
    assert {"recognised by LiDAR: 3 closures", "recognised by camera: 1 closure"} <= texts(charts)
    assert [text for text in texts(replace(charts, matches=[match(0, 1)])) if "camera" in text] == []


def test_it_says_how_many_robots_are_in_the_fused_map(charts):
    assert "3 of 3 robots in one coordinate frame" in texts(charts)
    assert "1 of 3 robots in one coordinate frame" in texts(replace(charts, fused=Chart(hall(), {"a": way()})))


def test_the_scale_bars_are_as_long_as_they_say(charts):
    axes = sheet(charts)
    bars = [np.ptp(line.get_xdata()) for line in axes.lines if len(line.get_xdata()) == 4]
    told = [float(text.get_text()[:-2]) for text in axes.texts if text.get_text().endswith(" m")]
    scales = [np.linalg.norm(pixel(axes, panel, 6, 0) - pixel(axes, panel, 0, 0)) / 6.0 for panel in (0, 4)]
    np.testing.assert_allclose(bars, np.array(told) * scales)


def test_few_of_many_matches_lie_far_apart():
    crowd = [match(0, 1, x=1.0 + 0.001 * k) for k in range(50)] + [match(0, 1, x=4.0), match(0, 2, x=4.0)]
    assert [(m.robot_j, float(m.xy_i[0])) for m in spread(crowd, 2)] == [("b", 1.0), ("b", 4.0), ("c", 4.0)]
    assert len(spread(crowd, 1000)) == len(crowd)


@pytest.mark.parametrize("robots", [2, 3, 8])
def test_lines_do_not_crowd_and_stay_under_the_titles(robots):
    names = [f"robot_{k}" for k in range(robots)]
    pairs = list(combinations(names, 2))
    xy = [np.array((x, 3.9)) for x in np.linspace(0.5, 5.5, 30)]
    matches = [MatchedPlaces(i, at, j, at, Channel.LIDAR, True) for i, j in pairs for at in xy]
    trajectories = {name: way() for name in names}
    local = {name: Chart(hall(), {name: way()}) for name in names}
    charts = FleetCharts(local, Chart(hall(), trajectories), Chart(hall(), trajectories), matches)
    lines = match_lines(charts)
    assert len(pairs) <= len(lines) <= max(MATCHES_DRAWN, len(pairs))
    title = next(text for text in sheet(charts).texts if text.get_text().startswith("no robot knows"))
    assert max(line.get_ydata().max() for line in lines) < title.get_position()[1]


def test_single_beams_do_not_widen_a_chart():
    grid = hall()
    free = np.pad(grid.free, ((0, 0), (0, 200)))
    free[40:42] = True
    beams = LabelledGrid(np.pad(grid.occupied, ((0, 0), (0, 200))), free, SIDE_M, np.zeros(3))
    np.testing.assert_allclose(Chart(beams, {}).bounds(), Chart(grid, {}).bounds())
    lost = Chart(beams, {"a": np.array([(12.0, 2.0, 0.0)])})
    assert lost.bounds()[1][0] == pytest.approx(12.0 + RAY_M)


def test_maps_of_nothing_are_still_a_figure(tmp_path):
    nothing = LabelledGrid(np.zeros((1, 1), np.bool_), np.zeros((1, 1), np.bool_), SIDE_M, np.zeros(3))
    stands = Chart(nothing, {"a": np.zeros((1, 3))})
    write_figure(FleetCharts({"a": stands}, stands, stands, []), tmp_path / "figure.png")
    assert cv2.imread(str(tmp_path / "figure.png")).shape[1] == WIDTH_PX


def test_the_same_charts_make_the_same_file(charts, tmp_path):
    for name in ("one.png", "two.png"):
        write_figure(charts, tmp_path / name)
    assert (tmp_path / "one.png").read_bytes() == (tmp_path / "two.png").read_bytes()
    with pytest.raises(OutputError, match="cannot be written"):
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


def test_what_is_missing_is_told(run_folder):
    (run_folder.parent / "recordings" / "ground_truth" / "map.yaml").unlink()
    with pytest.raises(EvaluationError, match=r"map\.yaml"):
        fleet_charts(run_folder)
    for file in (run_folder / "local").iterdir():
        file.unlink()
    (run_folder / "local").rmdir()
    with pytest.raises(EvaluationError, match="robots' own maps"):
        fleet_charts(run_folder)
