"""A whole fleet in one process: each folder of images is a robot's, and only Flower's messages pass between them."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from fcslam.config import dump
from fcslam.errors import OutputError, TrainingError
from fcslam.federated.client import client_app
from fcslam.federated.delivery import DETECTOR, deliver
from fcslam.federated.flower import Context
from fcslam.federated.grid import InProcessGrid
from fcslam.federated.history import RoundReport
from fcslam.federated.network import network_of, version_maker
from fcslam.federated.robot import RobotLearner, seeded_noise
from fcslam.federated.rounds import Outside, Server
from fcslam.federated.settings import FederatedSettings
from fcslam.federated.start import calibration_images, first_weights, judge_by, public_images
from fcslam.federated.weights import Weights
from fcslam.learning.export import export
from fcslam.learning.stages import Watch
from fcslam.learning.trainer import Pace

CONFIG_FILE = "config.yaml"


@dataclass(frozen=True, slots=True)
class Task:
    """What is asked for."""

    folders: Sequence[Path]
    """One for each robot, named like it."""
    output: Path
    settings: FederatedSettings
    start: Path | None = None
    """A checkpoint to begin from; None for synthetic shapes."""
    public: Sequence[Path] = ()
    """Folders of images that the server may look at."""


@dataclass(frozen=True, slots=True)
class Watches:
    """Who is told what."""

    stage: Watch = lambda _stage, _status: None
    steps: Callable[[str, int], None] = lambda _robot, _steps: None
    rounds: Callable[[RoundReport], None] = lambda _report: None


def federate_locally(task: Task, pace: Pace, watches: Watches) -> list[Path]:
    """Run or resume federated training in ``task.output``; returns the files that were made.

    Raises:
        TrainingError: folders have one name, a folder is unusable, no robot can train, or the output is another run's.
        OutputError: something cannot be written.
    """
    names = [folder.resolve().name for folder in task.folders]
    twice = {name for name in names if names.count(name) > 1}
    if twice:
        raise TrainingError(f"two folders are called {min(twice)}; a folder's name is the robot's, so rename one")
    for folder in task.folders:
        if not folder.is_dir():
            raise TrainingError(f"{folder}: is no folder; give one folder of images for each robot")
    images = public_images(task.public)
    _write_config(task, task.output / CONFIG_FILE)
    start = first_weights(task.start, task.output, task.settings, pace, watches.stage)
    robots = [
        RobotLearner(
            name,
            folder,
            task.output / "robots" / name,
            seeded_noise(name, task.settings.training.seed),
            pace.device,
            watches.steps,
        )
        for name, folder in zip(names, task.folders, strict=True)
    ]

    def robot_of(context: Context) -> RobotLearner:
        return robots[int(context.node_config["partition-id"])]

    encoder = task.settings.training.encoder

    def watch(report: RoundReport, best: Weights) -> None:
        if report.released:
            export(network_of(best, encoder), task.output / DETECTOR)
        watches.rounds(report)

    outside = Outside(version_maker(encoder), judge_by(images, encoder, pace.device), watch)
    state = Server(task.settings, start, task.output, outside).run(InProcessGrid(client_app(robot_of), len(robots)))
    _write_config(task, task.output / CONFIG_FILE, again=True)
    judged_on = "on pairs of public images" if images else "on pairs of images held out by the robots, their median"
    return deliver(state, task.output, task.settings, calibration_images(images), judged_on)


def _write_config(task: Task, path: Path, again: bool = False) -> None:
    """At the start, unless an earlier run's is there, and at the end."""
    try:
        task.output.mkdir(parents=True, exist_ok=True)
        if again or not path.exists():
            path.write_text(dump(task.settings), encoding="utf-8")
    except OSError as error:
        raise OutputError(f"{task.output}: cannot be used as the output folder ({error})") from error
