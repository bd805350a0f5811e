"""A federated run from its start to what it hands over, whatever carries the messages."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from fcslam.config import dump
from fcslam.errors import OutputError, TrainingError
from fcslam.federated.artifacts import DETECTOR, write_federated_artifacts
from fcslam.federated.client import NOISE_NEEDS_PUBLIC_IMAGES
from fcslam.federated.codec import version_maker, weights_to_network
from fcslam.federated.coordinator import Coordinator, CoordinatorHooks
from fcslam.federated.flower import Grid
from fcslam.federated.history import RoundReport
from fcslam.federated.initial_weights import (
    calibration_images,
    prepare_initial_weights,
    public_evaluator,
    read_public_images,
)
from fcslam.federated.settings import FederatedSettings
from fcslam.federated.weights import Weights
from fcslam.learning.export import export_onnx
from fcslam.learning.stages import StageCallback
from fcslam.learning.trainer import ExecutionOptions

CONFIG_FILE: Final = "config.yaml"


@dataclass(frozen=True, slots=True)
class FederatedJob:
    """What is asked of the server."""

    output: Path
    settings: FederatedSettings
    start: Path | None = None
    """A checkpoint or a released detector to begin from; None for synthetic shapes."""
    public: Sequence[Path] = ()
    """Folders of images that the server may look at."""


@dataclass(frozen=True, slots=True)
class ProgressCallbacks:
    """Who is told what."""

    stage: StageCallback = lambda _stage, _status: None
    steps: Callable[[str, int], None] = lambda _robot, _steps: None
    rounds: Callable[[RoundReport], None] = lambda _report: None


def run_job(
    task: FederatedJob,
    pace: ExecutionOptions,
    watches: ProgressCallbacks,
    grid: Grid,
    wait: Callable[[str], None] | None = None,
) -> list[Path]:
    """Run or resume; returns the files that were made. ``wait`` is as in ``CoordinatorHooks``.

    Raises:
        TrainingError: something given is unusable, no robot can train, or the output is another run's.
        OutputError: something cannot be written.
    """
    if task.settings.privacy.noise_multiplier and not task.public:
        raise TrainingError(NOISE_NEEDS_PUBLIC_IMAGES)
    images = read_public_images(task.public)
    _write_config(task, task.output / CONFIG_FILE)
    start = prepare_initial_weights(task.start, task.output, task.settings, pace, watches.stage, images)
    encoder = task.settings.training.encoder

    def watch(report: RoundReport, best: Weights) -> None:
        if report.released:
            export_onnx(weights_to_network(best, encoder), task.output / DETECTOR)
        watches.rounds(report)

    outside = CoordinatorHooks(version_maker(encoder), public_evaluator(images, encoder, pace.device), watch, wait)
    state = Coordinator(task.settings, start, task.output, outside).run(grid)
    _write_config(task, task.output / CONFIG_FILE, again=True)
    judged_on = "on pairs of public images" if images else "on pairs of images held out by the robots, their median"
    return write_federated_artifacts(state, task.output, task.settings, calibration_images(images), judged_on)


def _write_config(task: FederatedJob, path: Path, again: bool = False) -> None:
    """At the start, unless an earlier run's is there, and at the end."""
    try:
        task.output.mkdir(parents=True, exist_ok=True)
        if again or not path.exists():
            path.write_text(dump(task.settings), encoding="utf-8")
    except OSError as error:
        raise OutputError(f"{task.output}: cannot be used as the output folder ({error})") from error
