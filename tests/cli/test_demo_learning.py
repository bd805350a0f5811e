"""The demo's federated phase: each robot's images in a folder of its own, and only what is no worse is taken."""

from dataclasses import dataclass
from pathlib import Path

import pytest
from rich.console import Console

from fcslam.cli import demo, demo_learning
from fcslam.mission import MissionConfig
from fcslam.records import CameraImage, CameraModel, Transform

CAMERA = CameraModel(1, 1, 1.0, 1.0, 0.0, 0.0, Transform((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0)))


@dataclass
class Recorded:
    """A source of images that differ in their bytes."""

    name: str
    images: int

    def records(self):
        return [CameraImage(k, f"{self.name} {k}".encode(), CAMERA, None) for k in range(self.images)]


def learnt(folder, camera=True):
    """The detector that the demo takes, and the lines that it prints."""
    console = Console(record=True, width=200)
    sources = [Recorded("a", 100), Recorded("b", 3)]
    return demo._learn(sources, folder, 1, camera, console), console.export_text()


def test_without_the_libraries_one_line_says_how_to_get_them(tmp_path, monkeypatch):
    monkeypatch.setattr(demo_learning, "missing_libraries", lambda: ["torch", "flwr"])
    config, said = learnt(tmp_path / "learning")
    assert config == MissionConfig(seed=1)
    (line,) = said.splitlines()
    assert "torch and flwr are not installed" in line
    assert "pip install 'fcslam[federated]'" in line
    assert not (tmp_path / "learning").exists()


def test_without_a_camera_there_is_nothing_to_learn_from(tmp_path):
    config, said = learnt(tmp_path / "learning", camera=False)
    assert config == MissionConfig(seed=1)
    assert "no camera" in said


@pytest.mark.parametrize("released", [(False, False), (True, False), (False, True)])
def test_a_detector_is_taken_if_a_round_was_no_worse(released, tmp_path, monkeypatch):
    pytest.importorskip("torch", reason="needs fcslam[federated]")
    pytest.importorskip("flwr", reason="needs fcslam[federated]")
    from fcslam.features.detector import BUNDLED_NETWORK
    from fcslam.federated import local
    from fcslam.federated.history import RoundReport

    homes = []

    def federate_locally(folders, task, _pace, watches):
        assert task.start == BUNDLED_NETWORK
        homes.extend(folders)
        for number, accepted in enumerate(released, start=1):
            watches.rounds(RoundReport(number, f"light-{number}", ("a", "b"), released=accepted, bytes_down=5))
        return [task.output / "detector.onnx"]

    monkeypatch.setattr(local, "federate_locally", federate_locally)
    config, said = learnt(tmp_path / "learning")
    weights = config.robot.views.onnx.weights
    assert weights == (tmp_path / "learning" / "detector.onnx" if any(released) else None)
    assert ("the fleet takes it" in said) == any(released)
    assert [line[:9] for line in said.splitlines() if line.startswith("round")] == ["round 1/2", "round 2/2"]
    images = {home.name: sorted(path.read_bytes() for path in Path(home).iterdir()) for home in homes}
    assert len(images["a"]) == demo_learning.IMAGES
    assert {b"a 0", b"a 99"} <= set(images["a"])
    assert images["b"] == [b"b 0", b"b 1", b"b 2"]
