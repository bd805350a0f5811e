"""A fleet that learns while it maps, as real processes: one service and three robots.

They go through collection, rounds, release, adoption and describing old places again.
"""

import csv
import os
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
import yaml

from fcslam.features.detector import BUNDLED_NETWORK
from fcslam.lab.simulation.noise import LidarSettings
from fcslam.lab.simulation.options import Lighting
from fcslam.lab.simulation.recording import prepare_fleet_folder, record_robot
from fcslam.lab.simulation.simulated_fleet import CameraSettings, SimulationSettings, simulate_fleet
from fcslam.mission.mission_store import MissionStore
from fcslam.records import Channel
from fcslam.service.detectors import DetectorStore
from fcslam.wire.messages import PacketKind
from fcslam.wire.packets import decode
from tests.lab.simulation.gl import require_gl
from tests.postgres import free_port

LIMIT_S = 900.0
SETTINGS = {
    "fewest_pairs": 20,  # far fewer than 200, which only a test may do
    "federated": {"rounds": 2, "local_steps": 100, "minimum_robots": 3},
}  # fmt: skip
BROKEN_LAYER, NOISE = "body.code_head.0.0.weight", 6.0
"""Noise in this layer, in standard deviations of its weights, makes a detector that soon learns something."""


def heed_interrupts():
    """Also where the tests were started in the background, which ignores them."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)


def started(log, *words):
    with log.open("ab") as file:
        return subprocess.Popen(
            [sys.executable, "-m", "fcslam.cli", *map(str, words)],
            stdout=file, stderr=file, preexec_fn=heed_interrupts,  # noqa: PLW1509
            env={**os.environ, "PYTHONPATH": os.pathsep.join(path for path in sys.path if path)},
        )  # fmt: skip


def awaited(condition, processes, logs):
    end = time.monotonic() + LIMIT_S
    while not condition():
        texts = "\n".join(f"{log.name}:\n{log.read_text()[-3000:]}" for log in logs)
        assert all(process.poll() is None for process in processes), texts
        assert time.monotonic() < end, texts
        time.sleep(1.0)


def weak_detector(folder):
    """Announce a detector whose codes are bad, so that few steps of training improve it."""
    from fcslam.learning.export import export_onnx
    from fcslam.learning.federated.initial_weights import read_detector_weights
    from fcslam.learning.federated.networks import weights_to_network

    weights = read_detector_weights(BUNDLED_NETWORK, "light")
    layer = weights[BROKEN_LAYER]
    noise = np.random.default_rng(1).standard_normal(layer.shape)
    weights[BROKEN_LAYER] = (layer + NOISE * layer.std() * noise).astype(np.float32)
    export_onnx(weights_to_network(weights, "light"), folder / "weak.onnx")
    return DetectorStore(folder / "data" / "detectors").announce((folder / "weak.onnx").read_bytes()).version


def camera_places(folder):
    """Keyscans of camera places by robot and detector version."""
    store, found = MissionStore(folder / "data" / "missions" / "mission" / "mission.sqlite"), {}
    for _, packet in store.arrivals(0, 100_000):
        if packet.kind is PacketKind.PLACE and packet.channel is Channel.CAMERA:
            place = decode(packet.data).body
            found.setdefault((packet.robot, place.detector_version), set()).add(place.id.number)
    store.close()
    return found


@pytest.mark.training
def test_a_mission_goes_through_rounds_release_adoption_and_describing_again(tmp_path):
    require_gl()
    settings = SimulationSettings(
        robots=3, path_length_m=40.0, lighting=(Lighting.DAY, Lighting.EVENING),
        lidar=LidarSettings(rate_hz=5.0), camera=CameraSettings(rate_hz=3.0),
    )  # fmt: skip
    prepare_fleet_folder(tmp_path / "sim", settings, 5)
    robots = [robot.name for robot in simulate_fleet(settings, 5).robots]
    for robot in simulate_fleet(settings, 5).robots:
        record_robot(robot, tmp_path / "sim" / robot.name)
    weak = weak_detector(tmp_path)
    (tmp_path / "data").mkdir(exist_ok=True)
    (tmp_path / "data" / "learning.yaml").write_text(yaml.safe_dump(SETTINGS))
    port = free_port()
    logs = [tmp_path / f"{name}.log" for name in ("service", *robots)]
    service = started(logs[0], "serve", "--data", tmp_path / "data", "--port", port, "--learn")
    fleet = [
        started(log, "play", tmp_path / "sim" / robot, "--server", f"http://127.0.0.1:{port}", "--state",
                tmp_path / f"state-{robot}", "--learn")
        for robot, log in zip(robots, logs[1:], strict=True)
    ]  # fmt: skip
    everyone = [service, *fleet]
    try:
        rounds = tmp_path / "data" / "learning" / "rounds.csv"
        awaited(lambda: len(rows(rounds)) == SETTINGS["federated"]["rounds"], everyone, logs)
        version = next((row["version"] for row in reversed(rows(rounds)) if row["released"] == "1"), None)
        assert version is not None, [row["reason"] for row in rows(rounds)]
        adopted = f"detector {version} from now on"
        awaited(lambda: all(newest(log) == adopted for log in logs[1:]), everyone, logs)
        awaited(lambda: all((robot, version) in camera_places(tmp_path) for robot in robots), everyone, logs)
        for process in fleet:
            process.send_signal(signal.SIGTERM)
        assert [process.wait(LIMIT_S) for process in fleet] == [0, 0, 0]
        places = camera_places(tmp_path)
        for robot in robots:
            again = places[robot, weak] & places[robot, version]
            assert len(again) >= 0.9 * len(places[robot, weak]), "old places are described again"
        service.send_signal(signal.SIGINT)
        service.wait(LIMIT_S)
    finally:
        for process in everyone:
            process.kill()
            process.wait()


def rows(rounds):
    """The rounds so far."""
    if not rounds.exists():
        return []
    with rounds.open(newline="") as file:
        return list(csv.DictReader(file))


def newest(log):
    """The last line of a log on a detector."""
    return next((line for line in reversed(log.read_text().splitlines()) if line.startswith("detector ")), None)
