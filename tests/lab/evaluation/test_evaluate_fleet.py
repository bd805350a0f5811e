"""Run folders made here, with robots that really were where the truth says: what is wrong shows where it belongs."""

import json
from dataclasses import replace

import numpy as np
import pytest

from fcslam.cli import main
from fcslam.errors import InputError
from fcslam.geometry import se2
from fcslam.lab.evaluation.closures import ClosureScope
from fcslam.lab.evaluation.report import EvaluatedJoin, evaluate_fleet, fleet_metrics
from fcslam.records import Channel, ClosureStatus, Reason, ReasonCode, frozen
from fcslam.runs import ClosureRow, Metric, RobotTrajectory, Run, write_tum

pytestmark = pytest.mark.slow

STEPS = 151
"""Of each robot: 15 m, 0.5 m/s."""
T_BUILDING_MAP = np.array([3.0, -1.0, 0.7])
CANDIDATE, VERIFIED, ACCEPTED, REJECTED, REVOKED = ClosureStatus
LIDAR, CAMERA = Channel.LIDAR, Channel.CAMERA


def truth(robot):
    """Robots drive arcs that begin together; the third one drives the other way round."""
    angle = 0.01 * np.arange(STEPS) + 0.05 * robot
    poses = np.column_stack((10.0 * np.cos(angle), 10.0 * np.sin(angle), angle + np.pi / 2.0))
    return np.add(poses[::-1], (0.0, 0.0, np.pi)) if robot == 2 else poses


def stamps(robot):
    return 0.2 * np.arange(STEPS) + 0.001 * robot


def in_map(poses):
    return se2.compose(se2.inverse(T_BUILDING_MAP), poses)


def closure(i, j, status, channel=LIDAR, off=(0.0, 0.0, 0.0), similarity=0.5):
    """Between (robot, step) i and j."""
    T_i_j = se2.compose(se2.between(truth(i[0])[i[1]], truth(j[0])[j[1]]), off)
    ends = (f"r{i[0]}", float(stamps(i[0])[i[1]]), f"r{j[0]}", float(stamps(j[0])[j[1]]))
    return ClosureRow(*ends, channel, similarity, frozen(T_i_j), status, Reason(ReasonCode.VERIFIED))


def map_files(stem, occupied, free, origin):
    """As ROS map_server reads it; row 0 of the masks is the lowest y."""
    pixels = np.where(occupied, 0, np.where(free, 254, 205)).astype(np.uint8)
    height, width = pixels.shape
    keys = f"image: {stem}.pgm\nresolution: 0.05\norigin: [{', '.join(map(str, origin))}]\n"
    rest = "mode: trinary\nnegate: 0\noccupied_thresh: 0.65\nfree_thresh: 0.196\n"
    content = f"P5\n{width} {height}\n255\n".encode() + pixels[::-1].tobytes()
    return {f"{stem}.pgm": content, f"{stem}.yaml": (keys + rest).encode()}


def room():
    occupied = np.zeros((40, 70), dtype=np.bool_)
    occupied[5, 5:60] = occupied[30, 5:60] = occupied[5:30, 5] = True
    free = np.zeros_like(occupied)
    free[6:30, 6:60] = True
    return occupied, free


RUN = Run(
    {f"r{k}": RobotTrajectory(f"r{k}", 0, stamps(k), in_map(truth(k))) for k in range(3)},
    metrics={
        metric.name: metric
        for metric in (
            *(Metric(f"uplink_bytes_r{k}", 1000.0 * (k + 1), "B") for k in range(3)),
            Metric("lidar_place_packets", 4, "1"),
            Metric("lidar_place_bytes", 8000, "B"),
        )
    },
    map_files=map_files("map", *room(), in_map(np.array([1.0, 2.0, 0.0]))),
)


def changed(robot, moved=(0.0, 0.0, 0.0), map_index=0):
    """RUN with one robot moved within the map, or put into another."""
    old = RUN.trajectories[f"r{robot}"]
    new = replace(old, T_map_base=se2.compose(moved, old.T_map_base), map_index=map_index)
    return replace(RUN, trajectories={**RUN.trajectories, old.robot: new})


@pytest.fixture
def folder(tmp_path):
    """Where the run goes to, with the truth beside it."""
    recordings = tmp_path / "recordings"
    for robot in range(3):
        (recordings / f"r{robot}").mkdir(parents=True)
        write_tum(recordings / f"r{robot}" / "ground_truth.tum", stamps(robot), truth(robot))
    (recordings / "ground_truth").mkdir()
    for name, content in map_files("map", *room(), (1.0, 2.0, 0.0)).items():
        (recordings / "ground_truth" / name).write_bytes(content)
    return tmp_path / "run"


def report_of(run, folder, *closures):
    replace(run, closures=closures).save(folder, force=True)
    return evaluate_fleet(folder)


def test_a_run_that_is_the_truth_has_no_error(folder):
    report = report_of(RUN, folder, closure((0, 20), (1, 20), ACCEPTED))
    assert report.truth == folder.parent / "recordings"
    for score in report.robots:
        assert score.covered == score.poses == STEPS
        assert max(score.joint.max_m, score.alone.max_m) < 1e-6
        assert score.path_length_m == pytest.approx(15.0, abs=0.01)
        assert score.duration_s == pytest.approx(30.0)
    assert (report.maps, len(report.joins), report.false_joins) == (1, 3, ())
    assert max(report.within.translation.maximum, report.across.translation.maximum) < 1e-6
    found = report.agreement
    assert (found.precision, found.recall, found.f1) == (1.0, 1.0, 1.0)
    assert found.free_iou == pytest.approx(1.0, abs=0.005), "the map is turned, so it is drawn again along the axes"
    assert [score.uplink_bytes for score in report.robots] == [1000.0, 2000.0, 3000.0]
    assert report.places[LIDAR] == (4, 8000)
    assert np.isnan(report.places[CAMERA]).all()


def test_a_robot_moved_by_a_metre_is_a_false_join(folder):
    report = report_of(changed(1, (0.0, 1.0, 0.0)), folder)
    assert [(join.robot_a, join.robot_b) for join in report.false_joins] == [("r0", "r1"), ("r1", "r2")]
    assert report.false_joins[0].translation_m == pytest.approx(1.0, abs=1e-3)
    assert report.robots[1].joint.rmse_m > 0.4
    assert report.robots[1].alone.rmse_m < 1e-6
    assert report.within.translation.maximum < 1e-6
    assert report.across.translation.maximum == pytest.approx(1.0)
    assert report.agreement.f1 < 1.0, "the map is moved as the trajectories are"


def test_a_truth_in_utm_coordinates_gives_the_figures_of_a_truth_at_the_origin(folder):
    run = changed(1, (5.0, 5.0, 1.0))
    near = report_of(run, folder)
    for robot in range(3):
        poses = truth(robot) + np.array((453_000.0, 5_411_000.0, 0.0))
        write_tum(folder.parent / "recordings" / f"r{robot}" / "ground_truth.tum", stamps(robot), poses)
    far = report_of(run, folder)
    assert [(join.robot_a, join.robot_b) for join in far.false_joins] == [("r0", "r1"), ("r1", "r2")]
    for at_origin, off_origin in zip(near.joins, far.joins, strict=True):
        assert off_origin.translation_m == pytest.approx(at_origin.translation_m, abs=1e-4)
    for at_origin, off_origin in zip(near.robots, far.robots, strict=True):
        assert off_origin.joint.rmse_m == pytest.approx(at_origin.joint.rmse_m, abs=1e-4)


def test_a_join_whose_error_cannot_be_measured_is_not_counted_as_right():
    assert EvaluatedJoin("r0", "r1", np.nan, np.nan).is_false
    assert not EvaluatedJoin("r0", "r1", 0.5, 10.0).is_false


def test_robots_in_another_map_have_an_alignment_of_their_own(folder):
    report = report_of(changed(1, (40.0, 1.0, 2.0), map_index=1), folder)
    assert report.maps == 2
    assert [(join.robot_a, join.robot_b) for join in report.joins] == [("r0", "r2")]
    assert max(score.joint.max_m for score in report.robots) < 1e-6
    assert 0 < report.across.used < report.across.total
    assert report.agreement.f1 == 1.0


CLOSURES = (
    closure((0, 22), (1, 22), ACCEPTED, LIDAR, similarity=0.5),
    closure((0, 62), (1, 62), REJECTED, LIDAR, similarity=0.9),
    closure((1, 140), (0, 140), REVOKED, LIDAR, (0.6, 0.0, 0.0), similarity=0.5),
    closure((0, 30), (2, 120), CANDIDATE, LIDAR, (0.0, 0.0, 0.3), similarity=0.1),
    closure((1, 102), (0, 102), ACCEPTED, CAMERA, similarity=0.3),
    closure((2, 10), (2, 14), ACCEPTED, LIDAR),
)


def test_closures_are_counted_by_hand(folder):
    scores = report_of(RUN, folder, *CLOSURES).closures
    counts = {
        (str(status), channel): (score.precision.closures, score.precision.covered, score.precision.wrong)
        for (within, status, channel), score in scores.items()
        if within is ClosureScope.FLEET
    }
    assert counts == {
        ("candidate", "lidar"): (4, 4, 2), ("candidate", "camera"): (1, 1, 0), ("candidate", "both"): (5, 5, 2),
        ("verified", "lidar"): (3, 3, 1), ("verified", "camera"): (1, 1, 0), ("verified", "both"): (4, 4, 1),
        ("accepted", "lidar"): (1, 1, 0), ("accepted", "camera"): (1, 1, 0), ("accepted", "both"): (2, 2, 0),
    }  # fmt: skip
    assert scores[ClosureScope.ROBOT, ACCEPTED, "lidar"].precision.closures == 1
    assert scores[ClosureScope.ROBOT, ACCEPTED, "camera"].precision.closures == 0


def test_recall_counts_what_correct_closures_find(folder):
    scores = report_of(RUN, folder, *CLOSURES).closures
    lidar, camera, both = (scores[ClosureScope.FLEET, VERIFIED, channel] for channel in ("lidar", "camera", "both"))
    # Robot 1 is half a metre ahead. A closure at s metres of both finds those of robot 0 in [s - 1.5, s + 2], which are
    # four. Of robot 1 it finds those in [s - 2, s + 1.5], which are three.
    assert (lidar.recall.found, camera.recall.found, both.recall.found) == (14, 7, 21)
    # Of the lidar's verified ones the second is more similar than the wrong one, the first is as similar.
    found = [score.recall_full_precision.found for score in (lidar, camera, both)]
    assert found == [7, 7, 14]
    # robot 2 drives the other way round
    assert lidar.recall_like_heading.revisits < lidar.recall.revisits == both.recall.revisits
    assert lidar.recall_like_heading.found == lidar.recall.found
    assert scores[ClosureScope.FLEET, ACCEPTED, "lidar"].recall.found == 7
    assert scores[ClosureScope.ROBOT, ACCEPTED, "both"].recall.revisits == 0, "nobody comes back after a minute"


def test_a_closure_is_judged_by_the_truth_and_not_by_the_run(folder):
    moved = report_of(changed(1, (0.0, 5.0, 0.3)), folder, *CLOSURES).closures
    assert moved == report_of(RUN, folder, *CLOSURES).closures


def test_where_the_truth_ends_nothing_is_judged(folder):
    place = folder.parent / "recordings" / "r0" / "ground_truth.tum"
    write_tum(place, stamps(0)[:100], truth(0)[:100])
    report = report_of(RUN, folder, *CLOSURES)
    assert report.robots[0].covered == 100
    found = report.closures[ClosureScope.FLEET, VERIFIED, "both"].precision
    assert (found.closures, found.covered, found.wrong) == (4, 2, 0)


def test_truth_may_be_one_file_a_robot_and_beside_the_run(folder, tmp_path):
    RUN.save(folder)
    for robot in range(3):
        write_tum(tmp_path / f"r{robot}.tum", stamps(robot), se2.compose((9.0, 9.0, 1.0), truth(robot)))
    report = evaluate_fleet(folder, tmp_path)
    assert max(score.joint.max_m for score in report.robots) < 1e-6
    assert report.agreement is None


def test_metrics_have_unique_names_and_json_no_nan(folder, capsys):
    report = report_of(RUN, folder, *CLOSURES)
    metrics = fleet_metrics(report)
    assert len({metric.name for metric in metrics}) == len(metrics)
    assert main(["evaluate", "fleet", str(folder), "--csv", str(folder.parent / "table.json")]) == 0
    said = capsys.readouterr().out
    assert "falsely joined: none" in said
    assert "F1 of occupied cells 1.000" in said
    values = {row["name"]: row["value"] for row in json.loads((folder.parent / "table.json").read_text())}
    assert values["map_f1"] == 1.0
    assert values["camera_place_bytes"] is None
    assert values["inter_robot_verified_both_wrong"] == 1
    assert values["false_joins"] == 0
    assert values["ate_rmse_r2"] < 1e-6
    assert values.keys() == {metric.name for metric in metrics}


@pytest.mark.parametrize(
    ("file", "content", "message"),
    [
        ("r1/ground_truth.tum", None, "no truth of 'r1', neither r1/ground_truth.tum nor r1.tum; name the folder"),
        ("r1/ground_truth.tum", "", "empty, so where 'r1' was is not known"),
        (
            "r1/ground_truth.tum",
            "1e9 0 0 0 0 0 0 1\n",
            "poses at only 0 of the 151 scans of 'r1'; is it the",
        ),
        ("r1/ground_truth.tum", "1 2 3\n", "not a TUM trajectory"),
        ("ground_truth/map.pgm", "P5\n", "not a map for ROS map_server"),
        ("ground_truth/map.yaml", "image: [1, 2", "names no image"),
    ],
)
def test_bad_truth_is_one_line_and_exit_code_2(folder, capsys, file, content, message):
    RUN.save(folder)
    path = folder.parent / "recordings" / file
    path.unlink() if content is None else path.write_text(content)
    assert main(["evaluate", "fleet", str(folder)]) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.startswith("fcslam: ")
    assert error.count("\n") == 1


def test_a_run_without_robots_is_refused(folder):
    Run({}).save(folder)
    with pytest.raises(InputError, match="no robot"):
        evaluate_fleet(folder)
