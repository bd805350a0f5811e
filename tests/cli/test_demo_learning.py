"""The demo's federated stage: what it needs, and that only a version that passed the gate is taken."""

import pytest
from rich.console import Console

from fcslam.cli import main
from fcslam.mission.mission import MissionConfig

pytest.importorskip("torch", reason="needs fcslam[federated]")
pytest.importorskip("flwr", reason="needs fcslam[federated]")

from fcslam.cli import demo, demo_learning
from fcslam.learning.federated import job
from fcslam.learning.federated.client import RobotClient
from fcslam.learning.federated.history import RoundReport


class Recorded:
    name = "a"


@pytest.mark.parametrize("released", [(False, False), (True, False), (False, True)])
def test_a_detector_is_taken_if_a_round_passed_the_gate(released, tmp_path, monkeypatch):
    def run_job(task, _options, watches, _grid):
        assert task.gate.fewest_pairs == 200
        metrics = {"revisit_recall": 0.6, "revisit_recall_gain": 0.02, "pairs": 240.0}
        for number, passed in enumerate(released, start=1):
            reason = "better" if passed else "not better on held-out pairs"
            watches.rounds(
                RoundReport(
                    number, f"light-{number}", ("a",), metrics=metrics, score=0.6, released=passed, reason=reason
                )
            )
        return [task.output / "detector.onnx"]

    def learner(source, config, folder):
        return RobotClient(source.name, folder, folder)

    monkeypatch.setattr(job, "run_job", run_job)
    monkeypatch.setattr(demo_learning, "_learner", learner)
    console = Console(record=True, width=200)
    config = MissionConfig(seed=1)
    network = demo_learning.learn_together([Recorded()], config, tmp_path, console)
    said = console.export_text()
    assert network == (tmp_path / "detector.onnx" if any(released) else None)
    assert demo._with_detector(config, network).robot.views.onnx.weights == network
    taken = "60.0% match, +2.0 points, on 240 pairs that no robot trained on"
    assert (taken in said) == any(released)
    assert ("keeps the bundled detector: not better on held-out pairs" in said) == (not any(released))


def test_without_a_camera_there_is_nothing_to_learn_from(tmp_path, capsys):
    assert main(["demo", "--learn", "--no-camera", "--output", str(tmp_path / "demo")]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "nothing to learn from" in line
    assert not (tmp_path / "demo").exists()
