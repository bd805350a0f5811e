"""The same fleet through Flower's own daemons, over TLS and with keys: the result is that of one process."""

import csv
import json
import os
import signal
import subprocess
import sys
import time

import cv2
import pytest
import yaml
from federated.authority import certificates, keys
from learning.textures import textured

pytest.importorskip("torch", reason="needs fcslam[federated]")
pytest.importorskip("flwr", reason="needs fcslam[federated]")

from fcslam.cli import main
from fcslam.federated.deployed import read_status, read_task, task_text, write_status
from fcslam.federated.launch import free_port
from fcslam.federated.settings import FederatedSettings
from fcslam.federated.task import Task

TINY = {
    "rounds": 2,
    "local_steps": 2,
    "minimum_robots": 2,
    "collapse": 1.0,
    "training": {"shape_steps": 2, "pairs": 1, "side_px": 64, "points": 32, "label_copies": 1},
}


def test_a_task_arrives_as_it_was_sent(tmp_path):
    task = Task(tmp_path / 'a "name"', FederatedSettings.model_validate(TINY), None, (tmp_path / "p",))
    assert read_task(json.loads(json.dumps(task_text(task, "cpu")))) == (task, "cpu")


def test_the_status_is_what_was_written_last(tmp_path):
    assert read_status(tmp_path) == ("running", "")
    write_status(tmp_path, "waiting", "0 robots")
    write_status(tmp_path, "failed", "no room")
    assert read_status(tmp_path) == ("failed", "no room")


def start(*words, log):
    with log.open("ab") as file:
        return subprocess.Popen([sys.executable, "-m", "fcslam.cli", "federate", *words], stdout=file, stderr=file)


def versions(folder):
    with (folder / "rounds.csv").open() as file:
        return [(row["version"], row["robots"], row["released"]) for row in csv.DictReader(file)]


def line_of(capsys):
    (line,) = capsys.readouterr().err.splitlines()
    return line


def test_certificates_that_do_not_fit_end_in_one_line(tmp_path, capsys):
    """Another machine's, on the server and on a robot, before anything of Flower starts."""
    ours, theirs = certificates(tmp_path / "ours"), certificates(tmp_path / "theirs")
    keys(ours, "robot")
    (tmp_path / "robot").mkdir()
    files = ["--ca", str(ours / "ca.crt"), "--certificate", str(theirs / "own.crt"), "--key", str(theirs / "own.key")]
    common = ["federate", "-o", str(tmp_path / "out"), "--device", "cpu", *files, "--robot-key"]
    assert main([*common, str(ours / "robot.pub"), "--serve", "127.0.0.1:8000"]) == 2
    assert f"{theirs / 'own.crt'}: does not fit {ours / 'ca.crt'}" in line_of(capsys)
    assert main([*common, str(ours / "robot"), "--join", "127.0.0.1:8000", str(tmp_path / "robot")]) == 2
    assert f"{theirs / 'own.crt'}: does not fit {ours / 'ca.crt'}" in line_of(capsys)
    assert not (tmp_path / "out").exists()


class Deployment:
    """The fleet's processes, each a command of a user, over TLS and with keys."""

    def __init__(self, folder):
        self.folder, self.where = folder, f"127.0.0.1:{free_port()}"
        (folder / "tiny.yaml").write_text(yaml.safe_dump(TINY))
        for robot, seeds in (("one", (1, 2, 3)), ("two", (4, 5))):
            (folder / robot).mkdir()
            for seed in seeds:
                cv2.imwrite(str(folder / robot / f"{seed}.png"), textured(seed))
        own = certificates(folder / "keys")
        keys(own, "one", "two", "stranger")
        self._tls = ["--ca", str(own / "ca.crt"), "--certificate", str(own / "own.crt"), "--key", str(own / "own.key")]
        self._common = ["--config", str(folder / "tiny.yaml"), "--device", "cpu"]
        self._processes = []

    def embedded(self):
        """What the same robots make in one process."""
        folders = [str(self.folder / robot) for robot in ("one", "two")]
        log = self.folder / "embedded.log"
        process = start("--local", *folders, "-o", str(self.folder / "embedded"), *self._common, log=log)
        assert process.wait(300) == 0, log.read_text()
        return self.folder / "embedded"

    def server(self):
        public = [word for robot in ("one", "two") for word in ("--robot-key", str(self.folder / f"keys/{robot}.pub"))]
        words = ["--serve", self.where, "-o", str(self.folder / "deployed"), *self._common, *self._tls, *public]
        return self._started(*words, log="server")

    def robot(self, name, key=None):
        key = key or name
        words = ["--join", self.where, str(self.folder / name), "-o", str(self.folder / f"home-{key}")]
        words += ["--device", "cpu", *self._tls, "--robot-key", str(self.folder / "keys" / key)]
        return self._started(*words, log=key)

    def said(self, who):
        return (self.folder / f"{who}.log").read_text()

    def until(self, who, words, limit_s=240.0):
        """Wait until somebody has said something."""
        end = time.monotonic() + limit_s
        while words not in self.said(who):
            assert time.monotonic() < end, f"{who} never said '{words}', but: {self.said(who)}"
            time.sleep(0.5)

    def stop(self):
        for process in self._processes:
            process.send_signal(signal.SIGINT)
        for process in self._processes:
            process.wait(60)

    def _started(self, *words, log):
        process = start(*words, log=self.folder / f"{log}.log")
        self._processes.append(process)
        return process


@pytest.fixture
def deployment(tmp_path, monkeypatch):
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(path for path in sys.path if path))
    fleet = Deployment(tmp_path)
    yield fleet
    fleet.stop()


def assert_same(deployed, embedded):
    assert versions(deployed) == versions(embedded)
    assert (deployed / "detector.onnx").read_bytes() == (embedded / "detector.onnx").read_bytes()


@pytest.mark.system
def test_a_deployed_fleet_ends_as_one_in_a_process(deployment):
    embedded, server = deployment.embedded(), deployment.server()
    deployment.until("server", "waiting: 0 robots are there, 2 needed")
    stranger = deployment.robot("one", key="stranger")
    for robot in ("one", "two"):
        deployment.robot(robot)
    assert stranger.wait(120) == 2
    assert "does not take this robot" in deployment.said("stranger")
    assert server.wait(900) == 0, deployment.said("server")
    assert_same(deployment.folder / "deployed", embedded)


@pytest.mark.system
def test_a_server_whose_robots_all_die_waits_and_one_that_is_killed_goes_on(deployment):
    """Power cuts: both robots after the first round, then the server; who comes back ends as if nothing had been."""
    embedded, server = deployment.embedded(), deployment.server()
    robots = [deployment.robot(robot) for robot in ("one", "two")]
    deployment.until("server", "round 1/2")
    for robot in robots:
        robot.kill()
    deployment.until("server", "waiting: ")
    server.kill()
    server.wait(60)
    again = deployment.server()
    for robot in ("one", "two"):
        deployment.robot(robot)
    assert again.wait(900) == 0, deployment.said("server")
    assert_same(deployment.folder / "deployed", embedded)
