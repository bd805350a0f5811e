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
from learning.textures import textured

pytest.importorskip("torch", reason="needs fcslam[federated]")
pytest.importorskip("flwr", reason="needs fcslam[federated]")

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
EXTENSIONS = """subjectAltName=DNS:localhost,IP:127.0.0.1
extendedKeyUsage=serverAuth
keyUsage=critical,digitalSignature,keyEncipherment
basicConstraints=CA:FALSE
authorityKeyIdentifier=keyid
"""


def test_a_task_arrives_as_it_was_sent(tmp_path):
    task = Task(tmp_path / 'a "name"', FederatedSettings.model_validate(TINY), None, (tmp_path / "p",))
    assert read_task(json.loads(json.dumps(task_text(task, "cpu")))) == (task, "cpu")


def test_the_status_is_what_was_written_last(tmp_path):
    assert read_status(tmp_path) == ("running", "")
    write_status(tmp_path, "waiting", "0 robots")
    write_status(tmp_path, "failed", "no room")
    assert read_status(tmp_path) == ("failed", "no room")


def certificates(folder):
    def run(*words):
        subprocess.run(words, cwd=folder, check=True, capture_output=True)

    run("openssl", "req", "-x509", "-newkey", "rsa:2048", "-nodes", "-days", "2", "-subj", "/CN=test", "-keyout",
        "ca.key", "-out", "ca.crt", "-addext", "basicConstraints=critical,CA:TRUE", "-addext",
        "keyUsage=critical,keyCertSign,cRLSign")  # fmt: skip
    run("openssl", "req", "-newkey", "rsa:2048", "-nodes", "-subj", "/CN=localhost", "-keyout", "own.key", "-out",
        "own.csr")  # fmt: skip
    (folder / "extensions").write_text(EXTENSIONS)
    run("openssl", "x509", "-req", "-in", "own.csr", "-CA", "ca.crt", "-CAkey", "ca.key", "-CAcreateserial", "-days",
        "2", "-extfile", "extensions", "-out", "own.crt")  # fmt: skip
    for robot in ("one", "two", "stranger"):
        run("ssh-keygen", "-q", "-t", "ecdsa", "-b", "384", "-N", "", "-f", robot)


def start(*words, log):
    with log.open("wb") as file:
        return subprocess.Popen([sys.executable, "-m", "fcslam.cli", "federate", *words], stdout=file, stderr=file)


def versions(folder):
    with (folder / "rounds.csv").open() as file:
        return [(row["version"], row["robots"], row["released"]) for row in csv.DictReader(file)]


@pytest.mark.system
def test_a_deployed_fleet_ends_as_one_in_a_process(tmp_path, monkeypatch):
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(path for path in sys.path if path))
    for robot, seeds in (("one", (1, 2, 3)), ("two", (4, 5))):
        (tmp_path / robot).mkdir()
        for seed in seeds:
            cv2.imwrite(str(tmp_path / robot / f"{seed}.png"), textured(seed))
    (tmp_path / "tiny.yaml").write_text(yaml.safe_dump(TINY))
    keys = tmp_path / "keys"
    keys.mkdir()
    certificates(keys)
    common = ["--config", str(tmp_path / "tiny.yaml"), "--device", "cpu"]
    folders = [str(tmp_path / robot) for robot in ("one", "two")]
    embedded = start("--local", *folders, "-o", str(tmp_path / "embedded"), *common, log=tmp_path / "embedded.log")
    assert embedded.wait(300) == 0, (tmp_path / "embedded.log").read_text()
    where = f"127.0.0.1:{free_port()}"
    tls = ["--ca", str(keys / "ca.crt"), "--certificate", str(keys / "own.crt"), "--key", str(keys / "own.key")]
    public = [word for robot in ("one", "two") for word in ("--robot-key", str(keys / f"{robot}.pub"))]
    server = start(
        "--serve", where, "-o", str(tmp_path / "deployed"), *common, *tls, *public, log=tmp_path / "server.log"
    )
    robots = []
    try:
        time.sleep(15.0)
        for robot, key in (("one", "stranger"), ("one", "one"), ("two", "two")):
            home, log = tmp_path / f"home-{key}", tmp_path / f"{key}.log"
            words = ["--join", where, str(tmp_path / robot), "-o", str(home), "--device", "cpu", *tls]
            robots.append(start(*words, "--robot-key", str(keys / key), log=log))
        assert robots[0].wait(120) == 2
        assert "does not take this robot" in (tmp_path / "stranger.log").read_text()
        assert server.wait(900) == 0, (tmp_path / "server.log").read_text()
    finally:
        for process in (server, *robots):
            process.send_signal(signal.SIGINT)
        for process in (server, *robots):
            process.wait(60)
    assert versions(tmp_path / "deployed") == versions(tmp_path / "embedded")
    assert (tmp_path / "deployed" / "detector.onnx").read_bytes() == (
        tmp_path / "embedded" / "detector.onnx"
    ).read_bytes()
