"""The command: one robot against a cloud behind real HTTP."""

import io
import os
import re
import signal
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
from rich.console import Console

from fcslam.cli import live, main
from fcslam.cli.addresses import RosAddress
from fcslam.cli.inputs import open_recording
from fcslam.cli.output import notices
from fcslam.cli.play import robot_watch
from fcslam.cli.progress import ProgressDisplay
from fcslam.errors import CloudError, InputError
from fcslam.live.records import RobotStatus, Wiring
from fcslam.live.robot import Robot
from fcslam.ros.parameters import NodeParameters
from fcslam.ros.topics import SensorTopics
from fcslam.runs import read_tum
from fcslam.sources import BagOptions
from fcslam.sources.bags.codec import ODOMETRY, SCAN
from fcslam.wire.packets import decode
from tests import small_fleet
from tests.carmen_logs import write_carmen
from tests.live.same_thread import SameThread
from tests.robot.fake_cloud import FakeCloud
from tests.robot.http_cloud import serving
from tests.ros.memory_network import MemoryNetwork

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    path = tmp_path_factory.mktemp("recording") / "alice.clf"
    write_carmen(path, small_fleet.draw(1, path_length_m=6.0).robots[0].scans())
    return path


@pytest.fixture(autouse=True)
def same_thread(monkeypatch):
    """No process beside a robot; tests/test_commands_of_docs.py plays with one."""
    monkeypatch.setattr("fcslam.live.records.worker_process", SameThread)


@pytest.fixture
def cloud():
    with serving(FakeCloud(correction=4)) as cloud:
        yield cloud


def test_all_of_a_recording_arrives(log, cloud, tmp_path, capsys):
    state = tmp_path / "state"
    (tmp_path / "token").write_text("s3cret\n")
    assert main(["play", str(log), "--server", cloud.url, "--state", str(state), "--credentials", str(tmp_path)]) == 0
    assert {headers["Authorization"] for _, _, headers, _ in cloud.requests} == {"Bearer s3cret"}
    out, err = capsys.readouterr()
    stored = [decode(data) for data in cloud.cloud.stored.values()]
    assert {packet.robot for packet in stored} == {"alice"}
    scans, keyscans = map(int, re.match(r"(\d+) scans, (\d+) keyscans; ", out).groups())
    assert len(read_tum(state / "trajectory.tum")[0]) == scans
    assert keyscans == sum(type(packet.body).__name__ == "Keyscan" for packet in stored)
    assert "connected" in err
    assert (state / "outbox.sqlite").stat().st_mode & 0o077 == 0
    assert main(["play", str(log), "--server", cloud.url, "--state", str(state), "--resume"]) == 0
    assert len(cloud.cloud.stored) == len(stored), "nothing twice"
    (state / "trajectory.tum").unlink()
    (state / "trajectory.tum").mkdir()
    assert main(["play", str(log), "--server", cloud.url, "--state", str(state), "--resume"]) == 2
    assert "trajectory.tum: cannot be written (Is a directory)" in capsys.readouterr().err
    (state / "keyframes").mkdir()
    assert main(["play", f"bob={log}", "--server", cloud.url, "--state", str(state), "--learn"]) == 2
    assert "belongs to robot 'alice'" in capsys.readouterr().err
    assert (state / "keyframes").exists()


def test_a_2d_recording_in_3d_is_told_what_its_laser_does(log, cloud, tmp_path, capsys):
    cloud.canned.append((403, {}, b'{"error": "alice: sends poses in space"}'))
    play = ["play", str(log), "--3d", "--server", cloud.url, "--state", str(tmp_path)]
    assert main(play) != 0
    assert "alice: sends poses in space (403)" in capsys.readouterr().err, (
        "a service in the plane ends it with one line"
    )
    assert main([*play, "--resume"]) == 0
    err = capsys.readouterr().err.replace("\n", " ")
    assert err.count("alice: no point clouds, so its laser joins the 3D map") == 1


def test_a_laser_that_is_localized_in_a_3d_map_joins_nothing(log, capsys):
    open_recording(str(log), None, notices(), in_3d=True)
    assert "joins" not in capsys.readouterr().err


def test_a_cloud_that_turns_the_robot_away_is_one_line(log, cloud, tmp_path, refused):
    cloud.canned.append((401, {}, b'{"error": "no token"}'))
    assert f"fcslam: {cloud.url}: no token (401)" in refused("play", log, "--server", cloud.url, "--state", tmp_path)


@pytest.fixture
def heeded():
    """SIGINT is heeded, also where the tests were started in the background of a shell."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


def test_a_robot_that_is_stopped_twice_says_what_is_left_and_goes_on_later(
    log, cloud, tmp_path, monkeypatch, capsys, heeded
):
    play = ["play", str(log), "--state", str(tmp_path)]
    nowhere = ["--server", "http://127.0.0.1:9"]
    for number, options in ((signal.SIGINT, nowhere), (signal.SIGTERM, [*nowhere, "--resume"])):

        def interrupting(*_, number=number):
            return lambda now: now.waiting.packets and os.kill(os.getpid(), number)

        with monkeypatch.context() as patched:
            patched.setattr("fcslam.cli.play.robot_watch", interrupting)
            assert main([*play, *options]) == 130
        err = capsys.readouterr().err
        assert re.search(r"\d+ packets \(\d+ kB\) wait in .*; to continue, give --resume", err.replace("\n", " "))
    assert main([*play, "--server", cloud.url, "--resume"]) == 0
    assert list(cloud.cloud.stored) == [(0, k) for k in range(len(cloud.cloud.stored))]


def test_a_robot_whose_place_is_in_doubt_again_does_not_say_that_a_session_begins():
    console = Console(file=io.StringIO(), width=200)
    with ProgressDisplay(console) as display:
        watch = robot_watch(display, console, 100)
        for times_lost, quality in [(0, 0.0), (1, 0.0), (1, 0.5), (1, 0.0), (2, 0.0)]:
            watch(
                RobotStatus(
                    scans=9, keyscans=9, confirmed=9, sent_bytes=9, map_index=0, quality=quality, times_lost=times_lost
                )
            )
    said = [line.split(":")[0] for line in console.file.getvalue().splitlines()]
    assert said == ["connected", "lost", "relocalized in map 0, quality 0.50", "not relocalized", "lost"]


class Process:
    """Notes what a learning process gets; a test of its own covers that."""

    def __init__(self, told):
        self.set_idle = told.append
        self.close = lambda: told.append("closed")


def test_a_live_robot_learns_while_it_stands_and_pauses_when_it_drives():
    told = []
    robot = SimpleNamespace(name="anna", idle=lambda: told.append("keyframes are placed"))
    with live.standstill_learning(Process(told), robot) as follow:
        watch = live.pose_watch(told.append, follow)
        for scan in range(1, 30):
            x = 0.0 if scan < 20 else 1.0
            watch(scan, SimpleNamespace(stamp=float(scan), T_odom_base=np.array((x, 0.0, 0.0)), T_map_base=np.zeros(3)))
            watch(scan, None)  # another record, of no scan
    assert told == ["keyframes are placed", True, False, "closed"]


@pytest.mark.parametrize("failure", [CloudError("the token is not known (401)"), InputError("the disk is full")])
def test_a_live_robot_that_is_turned_away_does_not_lose_its_run(monkeypatch, tmp_path, capsys, failure):
    """Whatever the server or the outbox says, the drive is written; the error comes after it."""
    scans = list(small_fleet.draw(1, path_length_m=6.0).robots[0].scans())

    class Turned(Robot):
        def finish(self, *arguments):
            super().finish(*arguments)
            raise failure

    def run(node, _watch):
        for scan in scans:
            node._map(scan)

    kinds = {"/scan": SCAN, "/odom": ODOMETRY}
    topics = SensorTopics(kinds, ("/scan",), "/odom", ("/tf", "/tf_static"))
    monkeypatch.setattr("fcslam.ros.node.open_network", lambda *_: MemoryNetwork())
    monkeypatch.setattr("fcslam.ros.node.await_sensors", lambda *_: topics)
    monkeypatch.setattr("fcslam.ros.node.RobotNode.run", run)
    start = partial(Turned, wiring=Wiring(SameThread()))
    anna = live.LiveSource("anna", RosAddress("ros2", "/anna"), BagOptions(), NodeParameters())
    with pytest.raises(type(failure), match=re.escape(str(failure))):
        live.drive_live(anna, start, tmp_path / "run", Console(file=io.StringIO()))
    assert read_tum(tmp_path / "run" / "trajectories" / "anna.tum")[0].size == len(scans)
    assert f"{len(scans)} scans, 1 sessions" in capsys.readouterr().out


def test_a_robot_that_is_turned_away_stops_learning_and_maps_on():
    told = []

    def idle():
        raise CloudError("the token is not known (401)")

    robot = SimpleNamespace(name="anna", idle=idle)
    with live.standstill_learning(Process(told), robot) as follow:
        for scan in range(1, 30):
            follow(SimpleNamespace(stamp=float(scan), T_odom_base=np.zeros(3), T_map_base=np.zeros(3)))
    assert True not in told
