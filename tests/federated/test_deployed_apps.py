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

from tests.federated.authority import certificates, keys
from tests.learning.textures import textured

pytest.importorskip("torch", reason="needs fcslam[federated]")
pytest.importorskip("flwr", reason="needs fcslam[federated]")

from fcslam.cli import main
from fcslam.federated.deployed_apps import decode_job, encode_job, read_status, write_status
from fcslam.federated.job import FederatedJob
from fcslam.federated.launch import free_port
from fcslam.federated.settings import FederatedSettings

PATH = os.pathsep.join(path for path in sys.path if path)
LIMIT_S = 900.0
"""For whatever is waited for: on a busy machine Flower's processes take minutes to start."""
TINY = {
    "rounds": 2,
    "local_steps": 2,
    "minimum_robots": 2,
    "collapse": 1.0,
    "training": {"shape_steps": 2, "pairs": 1, "side_px": 64, "points": 32, "label_copies": 1},
}


def test_a_task_arrives_as_it_was_sent(tmp_path):
    task = FederatedJob(tmp_path / 'a "name"', FederatedSettings.model_validate(TINY), None, (tmp_path / "p",))
    assert decode_job(json.loads(json.dumps(encode_job(task, "cpu")))) == (task, "cpu")


def test_the_status_is_what_was_written_last(tmp_path):
    assert read_status(tmp_path) == ("running", "")
    write_status(tmp_path, "waiting", "0 robots")
    write_status(tmp_path, "failed", "no room")
    assert read_status(tmp_path) == ("failed", "no room")


def start(*words, log):
    """A command that an interrupt ends, even where the tests were started in the background, which ignores them."""
    command = [sys.executable, "-m", "fcslam.cli", "federate", *words]
    with log.open("ab") as file:
        return subprocess.Popen(command, stdout=file, stderr=file, preexec_fn=heed_interrupts)  # noqa: PLW1509


def heed_interrupts():
    signal.signal(signal.SIGINT, signal.SIG_DFL)


def versions(folder):
    with (folder / "rounds.csv").open() as file:
        return [(row["version"], row["robots"], row["released"]) for row in csv.DictReader(file)]


def line_of(capsys):
    (line,) = capsys.readouterr().err.splitlines()
    return line


@pytest.mark.slow
def test_certificates_that_do_not_fit_end_in_one_line(tmp_path, capsys):
    """Another machine's, on the server and on a robot, before anything of Flower starts."""
    ours, theirs = certificates(tmp_path / "ours"), certificates(tmp_path / "theirs")
    keys(ours, "robot")
    (tmp_path / "robot").mkdir()
    files = ["--ca", str(ours / "ca.crt"), "--certificate", str(theirs / "own.crt"), "--key", str(theirs / "own.key")]
    common = ["127.0.0.1:8000", "-o", str(tmp_path / "out"), "--device", "cpu", *files, "--robot-key"]
    assert main(["federate", "serve", *common, str(ours / "robot.pub")]) == 2
    assert f"{theirs / 'own.crt'}: does not fit {ours / 'ca.crt'}" in line_of(capsys)
    assert main(["federate", "join", *common, str(ours / "robot"), str(tmp_path / "robot")]) == 2
    assert f"{theirs / 'own.crt'}: does not fit {ours / 'ca.crt'}" in line_of(capsys)
    assert not (tmp_path / "out").exists()


@pytest.fixture(scope="module")
def embedded(tmp_path_factory):
    """Two robots' images, and what the robots make of them in one process."""
    folder = tmp_path_factory.mktemp("embedded")
    (folder / "tiny.yaml").write_text(yaml.safe_dump(TINY))
    for robot, seeds in (("one", (1, 2, 3)), ("two", (4, 5))):
        (folder / robot).mkdir()
        for seed in seeds:
            cv2.imwrite(str(folder / robot / f"{seed}.png"), textured(seed))
    folders = [str(folder / robot) for robot in ("one", "two")]
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PYTHONPATH", PATH)
        words = ["local", *folders, "-o", str(folder / "out"), "--config", str(folder / "tiny.yaml")]
        process = start(*words, "--device", "cpu", log=folder / "log")
    assert process.wait(LIMIT_S) == 0, (folder / "log").read_text()
    return folder


class Deployment:
    """The fleet's processes, each a command of a user, over TLS and with keys."""

    def __init__(self, folder, embedded):
        self.folder, self.where = folder, f"127.0.0.1:{free_port()}"
        self._images, self._processes = embedded, []
        own = certificates(folder / "keys")
        keys(own, "one", "two", "stranger")
        self._tls = ["--ca", str(own / "ca.crt"), "--certificate", str(own / "own.crt"), "--key", str(own / "own.key")]

    def server(self):
        words = ["serve", self.where, "-o", str(self.folder / "deployed"), "--device", "cpu", *self._tls]
        for robot in ("one", "two"):
            words += ["--robot-key", str(self.folder / "keys" / f"{robot}.pub")]
        return self._started(*words, "--config", str(self._images / "tiny.yaml"), log="server")

    def robot(self, name, key=None):
        key = key or name
        words = ["join", self.where, str(self._images / name), "-o", str(self.folder / f"home-{key}")]
        words += ["--device", "cpu", *self._tls, "--robot-key", str(self.folder / "keys" / key)]
        return self._started(*words, log=key)

    def said(self, who):
        return (self.folder / f"{who}.log").read_text()

    def until(self, who, words):
        """Wait until somebody has said something."""
        end = time.monotonic() + LIMIT_S
        while words not in self.said(who):
            assert time.monotonic() < end, f"{who} never said '{words}', but: {self.said(who)}"
            time.sleep(0.5)

    def stop(self):
        for process in self._processes:
            process.send_signal(signal.SIGINT)
        for process in self._processes:
            process.wait(180)

    def _started(self, *words, log):
        process = start(*words, log=self.folder / f"{log}.log")
        self._processes.append(process)
        return process


@pytest.fixture
def deployment(tmp_path, embedded, monkeypatch):
    monkeypatch.setenv("PYTHONPATH", PATH)
    fleet = Deployment(tmp_path, embedded)
    yield fleet
    fleet.stop()


def assert_same(deployed, embedded):
    assert versions(deployed) == versions(embedded)
    assert (deployed / "detector.onnx").read_bytes() == (embedded / "detector.onnx").read_bytes()


@pytest.mark.system
def test_a_deployed_fleet_ends_as_one_in_a_process(deployment, embedded):
    server = deployment.server()
    deployment.until("server", "waiting: 0 robots are there, 2 needed")
    stranger = deployment.robot("one", key="stranger")
    assert stranger.wait(LIMIT_S) == 2
    assert "does not accept this robot" in deployment.said("stranger")
    for robot in ("one", "two"):
        deployment.robot(robot)
    assert server.wait(LIMIT_S) == 0, deployment.said("server")
    assert_same(deployment.folder / "deployed", embedded / "out")


@pytest.mark.system
def test_a_server_whose_robots_all_die_waits_and_one_that_is_killed_goes_on(deployment, embedded):
    """Power cuts: both robots after the first round, then the server; who comes back ends as if nothing had been."""
    server = deployment.server()
    robots = [deployment.robot(robot) for robot in ("one", "two")]
    deployment.until("server", "round 1/2 ")
    for robot in robots:
        robot.kill()
    deployment.until("server", "waiting: ")
    server.kill()
    server.wait(60)
    for robot in ("one", "two"):
        deployment.robot(robot)
    for robot in ("one", "two"):
        deployment.until(robot, "waiting: nobody listens")
    again = deployment.server()
    assert again.wait(LIMIT_S) == 0, deployment.said("server")
    assert_same(deployment.folder / "deployed", embedded / "out")
