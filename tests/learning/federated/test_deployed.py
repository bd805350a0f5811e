"""The same fleet in processes of its own, over TLS and with tokens: the result is that of one process."""

import csv
import os
import shutil
import signal
import subprocess
import sys
import time
from datetime import UTC, datetime

import cv2
import pytest
import yaml

from fcslam.service.credentials import make_credentials
from fcslam.service.http.authentication import Role
from tests.learning.federated.authority import free_port
from tests.learning.textures import textured

pytest.importorskip("torch", reason="needs fcslam[federated]")
pytest.importorskip("flwr", reason="needs fcslam[federated]")


PATH = os.pathsep.join(path for path in sys.path if path)
LIMIT_S = 600.0
"""For whatever is waited for."""
TINY = {
    "rounds": 2,
    "local_steps": 2,
    "minimum_robots": 2,
    "training": {"shape_steps": 2, "pairs": 1, "side_px": 64, "label_copies": 1},
}


def start(*words, log):
    """A command that an interrupt ends, even where the tests were started in the background, which ignores them."""
    command = [sys.executable, "-m", "fcslam.cli", "tools", "federate", *words]
    with log.open("ab") as file:
        return subprocess.Popen(command, stdout=file, stderr=file, preexec_fn=heed_interrupts)  # noqa: PLW1509


def heed_interrupts():
    signal.signal(signal.SIGINT, signal.SIG_DFL)


def versions(folder):
    with (folder / "rounds.csv").open() as file:
        return [(row["version"], row["robots"], row["released"]) for row in csv.DictReader(file)]


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
        process = start(*words, log=folder / "log")
    assert process.wait(LIMIT_S) == 0, (folder / "log").read_text()
    return folder


class Deployment:
    """The fleet's processes, each a command of a user, over TLS and with tokens."""

    def __init__(self, folder, embedded):
        self.folder, self.where = folder, f"127.0.0.1:{free_port()}"
        self._images, self._processes = embedded, []
        self.keys, robots = folder / "keys", dict.fromkeys(("one", "two"), Role.ROBOT)
        for place in (self.keys, folder / "others"):
            make_credentials(place, ["127.0.0.1"], robots, datetime.now(UTC))
        # a stranger's token, and the right authority
        shutil.copy(self.keys / "ca.pem", folder / "others" / "robots" / "one" / "ca.pem")

    def server(self):
        words = ["serve", self.where, "-o", str(self.folder / "deployed"), "--credentials", str(self.keys)]
        return self._started(*words, "--config", str(self._images / "tiny.yaml"), log="server")

    def robot(self, name, owner=None, keys=None, log=None):
        log, keys = log or name, keys or self.keys
        words = ["join", f"https://{self.where}", str(self._images / name), "-o", str(self.folder / f"home-{name}")]
        words += ["--credentials", str(keys / "robots" / (owner or name))]
        return self._started(*words, log=log)

    def said(self, who):
        return (self.folder / f"{who}.log").read_text()

    def until(self, who, words):
        """Wait until somebody has said something."""
        end = time.monotonic() + LIMIT_S
        while words not in self.said(who):
            assert time.monotonic() < end, f"{who} never said '{words}', but: {self.said(who)}"
            time.sleep(0.2)

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
def deployment(tmp_path, embedded, monkeypatch):
    monkeypatch.setenv("PYTHONPATH", PATH)
    fleet = Deployment(tmp_path, embedded)
    yield fleet
    fleet.stop()


def assert_same(deployed, embedded):
    assert versions(deployed) == versions(embedded)
    assert (deployed / "detector.onnx").read_bytes() == (embedded / "detector.onnx").read_bytes()


@pytest.mark.training
def test_a_deployed_fleet_ends_as_one_in_a_process(deployment, embedded):
    server = deployment.server()
    deployment.until("server", "waiting: 0 robots are there, 2 needed")
    for owner, keys in (("two", deployment.keys), ("one", deployment.folder / "others")):
        refused = deployment.robot("one", owner, keys, log=f"refused-{owner}")
        assert refused.wait(LIMIT_S) == 2
        assert "the server does not accept this robot: it has no token of robot one" in deployment.said(
            f"refused-{owner}"
        )
    for robot in ("one", "two"):
        deployment.robot(robot)
    assert server.wait(LIMIT_S) == 0, deployment.said("server")
    assert_same(deployment.folder / "deployed", embedded / "out")


@pytest.mark.training
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
        deployment.robot(robot, log=f"{robot}-again")
    for robot in ("one", "two"):
        deployment.until(f"{robot}-again", "waiting: ")
    again = deployment.server()
    assert again.wait(LIMIT_S) == 0, deployment.said("server")
    assert_same(deployment.folder / "deployed", embedded / "out")
