"""`fcslam robot` and `fcslam record` against real rclpy: the map of a live robot is that of its bag.

`make ros-test` installs what this needs. Other environments skip it.
"""

import importlib.util
import json
import os
import signal
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import httpx
import numpy as np
import pytest

from fcslam.sources import write_bag
from tests import small_fleet
from tests.postgres import free_port
from tests.robot import spinning

ROOT = Path(__file__).parents[2]
RCLPY = Path(os.environ.get("FCSLAM_RCLPY", ROOT / ".venv-ros" / "bin" / "python"))
"""A Python with rclpy."""
HERE = Path(__file__).parent
SPEED = 4.0
LONGEST_S = 180.0

needs_rclpy = pytest.mark.skipif(
    not RCLPY.exists() or importlib.util.find_spec("cyclonedds") is None, reason="no rclpy or cyclonedds: make ros-test"
)
pytestmark = pytest.mark.system


@pytest.fixture(scope="module")
def scans():
    return list(small_fleet.draw(1, path_length_m=8.0).robots[0].scans())


@pytest.fixture(scope="module")
def folder(scans, tmp_path_factory):
    return mapped(scans, tmp_path_factory.mktemp("live"))


def spinning_scans():
    scans = spinning.drive(15.0, odometry=lambda stamp: spinning.pose_at(stamp) * (1.03, 1.03, 0.97))
    return [replace(scan, stamp=scan.stamp + 100.0) for scan in scans]  # ROS takes 0 for no stamp


def mapped(scans, folder):
    """The folder with the scans as a file for the players, and the run of the same scans as a bag."""
    for_player(folder / "scans.npz", scans)
    write_bag(folder / "bag.mcap", scans)
    ended(fcslam("map", f"robot1={folder / 'bag.mcap'}", "-o", folder / "expected", "-q"))
    return folder


def for_player(path, scans):
    """Write a robot's scans for ``rclpy_player.py``."""
    laser, sweep = scans[0].laser, scans[0].sweep
    np.savez(
        path,
        stamps=[scan.stamp for scan in scans],
        ranges=[scan.ranges_m for scan in scans],
        odometry=[scan.T_odom_base for scan in scans],
        laser=[laser.angle_min_rad, laser.angle_increment_rad, laser.max_range_m],
        beam_s=0.0 if sweep is None else sweep.duration_s / (laser.beam_count - 1),
    )


def fcslam(*arguments, cwd=None, **environment):
    return subprocess.Popen(
        [sys.executable, "-m", "fcslam.cli", *map(str, arguments)],
        cwd=cwd,
        env={**os.environ, "PYTHONPATH": str(ROOT / "src"), **environment},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def ended(process, *others):
    """The output of the command; it ended with 0 or one of the ``others``."""
    try:
        out, error = process.communicate(timeout=LONGEST_S)
    finally:
        process.kill()
    assert process.returncode in (0, *others), out + error
    return out + error


def play(folder, namespace="/robot1", **environment):
    """The drive as its player saw it."""
    command = [RCLPY, HERE / "rclpy_player.py", folder / "scans.npz", namespace, SPEED]
    done = subprocess.run(
        list(map(str, command)), env={**os.environ, **environment}, capture_output=True, text=True, timeout=LONGEST_S,
        check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1])


def poses(run):
    return np.loadtxt(run / "trajectories" / "robot1.tum")


def ros2(domain):
    return {
        "ROS_DOMAIN_ID": str(domain),
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
        "RMW_IMPLEMENTATION": "rmw_fastrtps_cpp",
    }


def mounting(scans):
    return "--sensors=laser-pose=" + ",".join(map(str, scans[0].laser.T_base_laser))


def check_drive(played, scans, output, folder):
    assert played["played"] == played["posed"] == len(scans)
    assert played["frame"] == "map"
    assert played["values"] == [-1, 0, 100]
    assert played["faults"] == []
    assert played["path"] > 5
    expected = poses(folder / "expected")
    assert np.abs(poses(output) - expected).max() < 1e-3
    assert (output / "map.pgm").read_bytes() == (folder / "expected" / "map.pgm").read_bytes()


@needs_rclpy
@pytest.mark.parametrize("is_spinning", [False, True])
def test_a_robot_of_ros_2(is_spinning, scans, folder, tmp_path):
    if is_spinning:
        scans = spinning_scans()
        folder = mapped(scans, tmp_path)
    environment = ros2(45 if is_spinning else 41)
    robot = fcslam("robot", "ros2:/robot1", mounting(scans), "-o", tmp_path / "run", **environment)
    played = play(folder, **environment)
    ended(robot)
    check_drive(played, scans, tmp_path / "run", folder)


@needs_rclpy
def test_a_recording_of_ros_2(folder, scans, tmp_path):
    environment = ros2(42)
    recorder = fcslam("record", "ros2:/robot1", "-o", tmp_path / "robot1.mcap", **environment)
    play(folder, **environment)
    recorder.send_signal(signal.SIGINT)
    assert f"{len(scans)} of /robot1/scan" in ended(recorder)
    ended(fcslam("map", tmp_path / "robot1.mcap", mounting(scans), "-o", tmp_path / "run", "-q"))
    assert np.abs(poses(tmp_path / "run") - poses(folder / "expected")).max() < 1e-3


@needs_rclpy
def test_a_robot_that_nobody_knows_on_ros_2():
    process = fcslam("robot", "ros2:/nobody", "--ros-parameters", HERE / "hurry.yaml", **ros2(43))
    _, error = process.communicate(timeout=LONGEST_S)
    assert process.returncode == 2
    assert "no laser scans (sensor_msgs/LaserScan)" in error
    assert " in /nobody; " in error
    assert "Traceback" not in error


@pytest.fixture
def port(tmp_path):
    """The port of a service."""
    port = free_port()
    with fcslam("serve", "--data", tmp_path / "missions", "--port", port) as server:
        yield port
        server.kill()


@needs_rclpy
def test_three_robots_of_ros_2_share_one_map(drawn, tmp_path, port):
    environment = ros2(44)
    robots, players = [], []
    for robot in drawn.robots:
        scans, folder = list(robot.scans()), tmp_path / robot.name
        folder.mkdir()
        for_player(folder / "scans.npz", scans)
        words = ["robot", f"ros2:/{robot.name}", mounting(scans), "-o", folder / "run", "--state", folder / "state"]
        robots.append(fcslam(*words, "--server", f"http://127.0.0.1:{port}", **environment))
        players.append((folder, f"/{robot.name}"))
    try:
        with ThreadPoolExecutor() as pool:
            drives = list(pool.map(lambda player: play(*player, **environment), players))
    finally:
        for robot in robots:
            ended(robot)
    assert all(drive["posed"] == drive["played"] for drive in drives)
    assert all(drive["faults"] == [] for drive in drives)
    end = time.monotonic() + LONGEST_S
    while len(maps := maps_of(port)) != 1 and time.monotonic() < end:
        time.sleep(1.0)
    assert maps == {0: {"robot_1", "robot_2", "robot_3"}}


def maps_of(port):
    """The robots of each map of a service."""
    maps = {}
    for robot in httpx.get(f"http://127.0.0.1:{port}/api/v1/robots").json():
        maps.setdefault(robot["map"], set()).add(robot["robot"])
    return maps
