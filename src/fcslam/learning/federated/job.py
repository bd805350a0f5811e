"""A federated training job from the initial weights to the exported detector: over any transport, or in one process."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Final

from fcslam.config import dump
from fcslam.errors import InputError, writing
from fcslam.learning.artifacts import write_artifacts
from fcslam.learning.export import export_onnx
from fcslam.learning.federated.client import RobotClient
from fcslam.learning.federated.coordinator import RULES, Coordinator, CoordinatorHooks, RoundRules
from fcslam.learning.federated.fleets import InProcessFleet, TrainingFleet
from fcslam.learning.federated.history import RoundReport
from fcslam.learning.federated.initial_weights import prepare_initial_weights
from fcslam.learning.federated.networks import weights_to_network, weights_version
from fcslam.learning.federated.public_images import public_evaluation, read_public_images
from fcslam.learning.federated.report import federated_report
from fcslam.learning.federated.settings import FederatedSettings
from fcslam.learning.federated.weights import Weights
from fcslam.learning.settings import DETECTOR
from fcslam.learning.stages import StageCallback
from fcslam.learning.trainer import ExecutionOptions

CONFIG_FILE: Final = "config.yaml"


@dataclass(frozen=True, slots=True)
class FederatedJob:
    """The job of the server."""

    output: Path
    """Folder of the run; a run in it is continued."""
    settings: FederatedSettings
    start: Path | None = None
    """Checkpoint or exported detector to start from; None for a detector trained on synthetic shapes."""
    public: Sequence[Path] = ()
    """Folders of images that the server may read; without any, the robots evaluate."""
    rules: RoundRules = RULES


@dataclass(frozen=True, slots=True)
class ProgressCallbacks:
    """Functions that are called as training advances."""

    stage: StageCallback = lambda _stage, _progress: None
    """With the stage before the rounds, and its progress."""
    steps: Callable[[str, int], None] = lambda _robot, _steps: None
    """With a robot's name and the steps that it has done in the round."""
    rounds: Callable[[RoundReport], None] = lambda _report: None
    """With the report of a round."""
    released: Callable[[Weights], None] = lambda _weights: None
    """With the weights of a released version; its detector is written. A start that continues a run calls it again."""


def run_job(
    job: FederatedJob,
    options: ExecutionOptions,
    callbacks: ProgressCallbacks,
    fleet: TrainingFleet,
    wait: Callable[[str], None] | None = None,
) -> list[Path]:
    """Run a job, or continue it; returns the files for the user: detector, picture of the rounds, and model card.

    ``wait``: as in ``CoordinatorHooks``.
    """
    images = read_public_images(job.public)
    _write_config(job, job.output / CONFIG_FILE)
    initial = prepare_initial_weights(job.start, job.output, job.settings.training, options, callbacks.stage, images)
    encoder = job.settings.training.encoder

    def on_release(weights: Weights) -> None:
        export_onnx(weights_to_network(weights, encoder), job.output / DETECTOR)
        callbacks.released(weights)

    version = partial(weights_version, encoder=encoder)
    evaluate = public_evaluation(images, encoder, options.device)
    hooks = CoordinatorHooks(version, evaluate, callbacks.rounds, on_release, wait)
    state = Coordinator(fleet, job.settings, initial, job.output, hooks, job.rules).run()
    _write_config(job, job.output / CONFIG_FILE, again=True)
    judged_on = (
        "on pairs of public images"
        if images
        else "on images of the robots, 4 % held out or one trained on; median of the robots"
    )
    if job.rules.lesson == "revisits":
        judged_on = "on revisits that no robot trained on, mean"
    network = weights_to_network(state.best, encoder)
    report = federated_report(state, job.output, judged_on)
    return write_artifacts(network, job.output, "rounds.png", job.settings, report)


def _write_config(job: FederatedJob, path: Path, again: bool = False) -> None:
    """Write the settings at the end, and at the start unless an earlier start has written them."""
    with writing(job.output, "choose another output folder"):
        job.output.mkdir(parents=True, exist_ok=True)
        if again or not path.exists():
            path.write_text(dump(job.settings), encoding="utf-8")


def federate_locally(
    folders: Sequence[Path],
    job: FederatedJob,
    options: ExecutionOptions,
    callbacks: ProgressCallbacks,
    most_images: int | None = None,
) -> list[Path]:
    """Run or continue federated training; returns the files for the user, see ``run_job``.

    ``folders`` hold the images of each robot, which has the name of its folder. It trains on its first ``most_images``
    alone; None for all.
    """
    names = [folder.resolve().name for folder in folders]
    twice = {name for name in names if names.count(name) > 1}
    if twice:
        raise InputError(f"two folders are called {min(twice)}; a robot has its folder's name, so rename one")
    for folder in folders:
        if not folder.is_dir():
            raise InputError(f"{folder}: is not a folder; give one folder of images for each robot")
    clients = [
        RobotClient(
            name, folder, job.output / "robots" / name, options.device, callbacks.steps, most_images=most_images
        )
        for name, folder in zip(names, folders, strict=True)
    ]
    return run_job(job, options, callbacks, InProcessFleet(clients))
