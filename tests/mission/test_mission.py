"""Recordings in, one run out, and what the run says adds up."""

import json
from dataclasses import replace

import numpy as np
import pytest

from fcslam.errors import FcslamError, PacketError, SourceError
from fcslam.mission import mission
from fcslam.mission.mission import MissionConfig, MissionInputs, continued_config, run_mission
from fcslam.mission.mission_file import EMPTY, read_mission
from fcslam.records import Channel, ClosureStatus, Veto
from fcslam.sources import open_source
from tests.carmen_logs import write_carmen
from tests.lidar.worlds import Recording
from tests.robot.kidnapping import kidnapping


@pytest.fixture(scope="module")
def watched(logs):
    """A run, and the progress that was reported during it."""
    seen = []
    return run_mission([open_source(log) for log in logs], MissionConfig(seed=3), seen.append), seen


@pytest.fixture(scope="module")
def run(watched):
    return watched[0]


@pytest.mark.slow
def test_a_robot_that_was_lost_is_two_sessions_that_a_veto_may_name():
    settings = MissionConfig()
    robot = settings.robot.model_copy(update={"channels": (Channel.LIDAR,)})
    seen = []
    scans, moment = kidnapping()
    config, inputs = settings.model_copy(update={"robot": robot}), MissionInputs(vetoes=(Veto("r", "r+1"),))
    run = run_mission([Recording(scans)], config, seen.append, inputs)
    assert run.metrics["keyscans"].value == seen[-1].keyscans
    first, second = run.trajectories.values()
    assert (first.robot, second.robot) == ("r", "r+1")
    assert [*first.stamps, *second.stamps] == [scan.stamp for scan in scans]
    assert first.stamps[-1] == moment
    assert first.map_index != second.map_index


def test_the_watcher_sees_progress_to_the_last_scan_and_then_that_the_cloud_fuses(watched):
    run, seen = watched
    assert [now.fusing for now in seen] == [False] * (len(seen) - 1) + [True]
    assert [now.scans for now in seen] == sorted(now.scans for now in seen)
    assert seen[-1].scans == sum(len(trajectory.stamps) for trajectory in run.trajectories.values())
    assert [now.keyscans for now in seen] == sorted(now.keyscans for now in seen)
    assert json.loads(json.dumps(seen[-1].closures)).keys() == {"within robots", "between robots"}


@pytest.mark.slow
def test_the_order_of_the_recordings_does_not_matter(run, logs):
    turned = run_mission([open_source(log) for log in reversed(logs)], MissionConfig(seed=3))
    assert turned.closures
    assert [str(c) for c in turned.closures] == [str(c) for c in run.closures]
    assert turned.pose_graph_g2o == run.pose_graph_g2o
    assert turned.map_files["map.pgm"] == run.map_files["map.pgm"]
    poses = {t.robot: t.T_map_base.tobytes() for t in run.trajectories.values()}
    assert {t.robot: t.T_map_base.tobytes() for t in turned.trajectories.values()} == poses


@pytest.mark.slow
def test_a_robots_own_map_is_what_it_would_have_mapped_alone(run, logs):
    """To the last bit: no other robot has a say in it, and its trajectory starts at the origin."""
    (alone,) = run_mission([open_source(logs[1])], MissionConfig(seed=3)).local_maps.values()
    second = run.local_maps["robot_2"]
    assert (second.robot, second.pgm, second.yaml) == (alone.robot, alone.pgm, alone.yaml)
    assert second.T_local_base.tobytes() == alone.T_local_base.tobytes()
    assert np.array_equal(second.T_local_base[0], np.zeros(3))
    for local, joint in zip(run.local_maps.values(), run.trajectories.values(), strict=True):
        assert np.array_equal(local.stamps, joint.stamps)
    assert np.abs(second.T_local_base - run.trajectories["robot_2"].T_map_base).max() > 0.5, "another frame"


def test_numbers_add_up(run, drawn):
    values = {name: metric.value for name, metric in run.metrics.items()}
    assert values["robots"] == 3
    assert values["maps"] == len({t.map_index for t in run.trajectories.values()})
    assert values["scans"] == sum(len(robot.stamps) for robot in drawn.robots)
    assert values["recorded_time"] == pytest.approx(sum(r.stamps[-1] - r.stamps[0] for r in drawn.robots))
    assert values["keyscans"] == values["keyscan_packets"] == run.pose_graph_g2o.count("VERTEX_SE2")
    assert values["hello_packets"] == 3
    assert 3 <= values["correction_packets"] < values["place_packets"], "only those that are news"
    for figure in ("packets", "bytes"):
        assert values[f"place_{figure}"] == values[f"lidar_place_{figure}"] + values[f"camera_place_{figure}"]
    sent = sum(values[f"{kind}_bytes"] for kind in ("hello", "keyscan", "constraint", "place"))
    assert sent == sum(values[f"uplink_bytes_{robot.name}"] for robot in drawn.robots)
    assert values["correction_bytes"] == sum(values[f"downlink_bytes_{robot.name}"] for robot in drawn.robots)
    for robot in drawn.robots:
        for link in ("uplink", "downlink"):
            over = values[f"{link}_bytes_{robot.name}"] / (robot.stamps[-1] - robot.stamps[0]) / 1e3
            assert values[f"{link}_rate_{robot.name}"] == pytest.approx(over)
    for status in ClosureStatus:
        between = [c for c in run.closures if c.robot_i != c.robot_j and c.status is status]
        assert values[f"inter_robot_closures_{status}"] == len(between)
    assert values["inter_robot_closures_verified"] == 0, "in the end every closure is decided"


def test_closures_tell_where_and_why(run):
    stamps = {t.robot: set(np.round(t.stamps, 6)) for t in run.trajectories.values()}
    for closure in run.closures:
        assert round(closure.stamp_i, 6) in stamps[closure.robot_i]
        assert round(closure.stamp_j, 6) in stamps[closure.robot_j]
        assert 0.0 <= closure.similarity <= 1.0
        assert holds_setting(closure.reason.setting)


def holds_setting(name):
    """Whether the configuration has this setting; a reason without a limit names none."""
    part = MissionConfig()
    for step in name.split(".") if name else ():
        part = getattr(part, step)
    return True


def test_the_settings_of_the_cloud_go_into_a_mission_and_out_of_it():
    given = MissionConfig.model_validate({"seed": 3, "fleet": {"solve_every": 5}, "map": {"resolution_m": 0.1}})
    kept = replace(EMPTY, config=given.cloud)
    assert continued_config(kept) == given


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "error"),
    [("a b.clf", None), ("_robot.clf", None), ("(1).log", None), ("Ä.log", None), ("x" * 90 + ".log", SourceError)],
)
def test_a_recording_may_have_any_name_that_a_robot_can_bear(tmp_path, drawn, name, error):
    """Names go over the wire and into file names; one that cannot is refused before the work."""
    robot = drawn.robots[0]
    path = tmp_path / name
    write_carmen(path, list(robot.scans())[:12])
    sources = [open_source(path)]
    if error is None:
        assert len(run_mission(sources, MissionConfig()).trajectories) == 1
        return
    with pytest.raises(error, match="rename"):
        run_mission(sources, MissionConfig(), watch=lambda _: pytest.fail("worked"))


@pytest.mark.parametrize("left_out", [0, 20])
@pytest.mark.parametrize("later", [False, True])
def test_scans_that_another_recording_has_are_refused(tmp_path, drawn, left_out, later):
    """A copy or a part of a recording, in the same mission or in one that goes on from it."""
    scans = list(drawn.robots[0].scans())
    for name, its in (("whole", scans), ("part", scans[left_out:])):
        write_carmen(tmp_path / f"{name}.clf", its)
    whole, part = (open_source(tmp_path / f"{name}.clf") for name in ("whole", "part"))
    run_mission([whole], MissionConfig()).save(tmp_path / "run")
    onto, given = (read_mission(tmp_path / "run"), [part]) if later else (EMPTY, [whole, part])
    with pytest.raises(
        SourceError, match=r"have the same scans at \d+\.\d+ s, so they are copies or overlapping parts"
    ):
        run_mission(given, MissionConfig(), inputs=MissionInputs(onto))


def test_a_refusal_by_the_cloud_is_not_lost(logs, monkeypatch):
    def refuse(_self, _packet):
        raise PacketError("no room")

    monkeypatch.setattr(mission.Cloud, "apply", refuse)
    with pytest.raises(FcslamError, match=r"robot_1.*no room"):
        run_mission([open_source(logs[0])], MissionConfig())
