"""The training loop: it draws pairs, does steps, averages the network, validates it and writes checkpoints.

A step depends on the seed, its number and the state before it. So a run that was interrupted gives the same result.
"""

import csv
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import torch
from torch import Tensor

from fcslam.errors import InputError, writing
from fcslam.learning.artifacts import Curve
from fcslam.learning.batches import batch_stream, on_device
from fcslam.learning.network import KeypointNetwork
from fcslam.learning.objective import TeacherBits
from fcslam.learning.pairs import TrainingExample
from fcslam.learning.settings import TrainingSettings
from fcslam.learning.training_loop import (
    create_optimizer,
    descend,
    get_optimizer_state,
    restore_optimizer_state,
    step_losses,
)
from fcslam.learning.validation import collapse_warnings, validate, validation_pairs
from fcslam.storage.state_file import State, read_state, write_state

AVERAGE_DECAY: Final = 0.999
"""Share of the averaged network that a step keeps; early steps keep less, so that it forgets the initial network."""
CHECKPOINT_FILE: Final = "checkpoint.state"
CHECKPOINT_FORMAT: Final = "fcslam training 2"
PROGRESS_FILE: Final = "progress.csv"


@dataclass(frozen=True, slots=True)
class ExecutionOptions:
    """Where training computes, and how often it reports. None of this changes the result on one device."""

    validate_every: int = 500
    """Steps between two validations."""
    checkpoint_every_s: float = 120.0
    """Time between two checkpoints."""
    log_every: int = 50
    """Steps between two rows of losses in the log."""
    threads: int = 1
    """Threads that prepare batches."""
    device: str = "cpu"
    """Name of a device in torch."""


ProgressCallback = Callable[[int, int, Mapping[str, float], tuple[str, ...]], None]
"""Called with the steps done, all steps, the latest losses and metrics, and the latest validation's warnings."""


class TrainingRun:
    """Training in a folder. It continues from the checkpoint there."""

    def __init__(
        self,
        settings: TrainingSettings,
        folder: Path,
        options: ExecutionOptions,
        start: dict[str, Tensor] | None = None,
        examples: int = 0,
    ) -> None:
        """``examples`` is a checksum of what is trained on and from; a checkpoint of something else is refused."""
        self.settings, self.folder, self.options = settings, folder, options
        self.device = torch.device(options.device)
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(settings.seed)
            network = KeypointNetwork(settings.encoder)
        self.network = network.to(self.device, memory_format=torch.channels_last)
        if start is not None:
            self.network.load_state_dict(start)
        self.average = KeypointNetwork(settings.encoder).to(self.device)
        self.average.load_state_dict(self.network.state_dict())
        self.average.eval()
        self.optimizer = create_optimizer(self.network)
        self.step = 0
        self._examples = examples
        self._saved = time.monotonic()

    def train(
        self,
        examples: Sequence[TrainingExample],
        held_out: Sequence[TrainingExample],
        bits: TeacherBits | None = None,
        on_progress: ProgressCallback = lambda *_: None,
    ) -> KeypointNetwork:
        """Train to the last step; returns the averaged network. ``bits`` are a teacher's, if the examples have one."""
        settings, options = self.settings, self.options
        with writing(self.folder, "choose another output folder"):
            self.folder.mkdir(parents=True, exist_ok=True)
        self._resume()
        bits = None if bits is None else on_device(bits, self.device)
        views = validation_pairs(held_out)
        metrics: dict[str, float] = {}
        warnings: tuple[str, ...] = ()
        steps = range(self.step, settings.steps)
        batches = batch_stream(examples, settings, steps, 4 * options.threads, options.threads)

        def losses_of(step: int) -> tuple[Tensor, dict[str, Tensor]]:
            return step_losses(self.network, on_device(next(batches), self.device), settings, step, bits)

        self.network.train()
        with closing(batches):
            for step, parts in descend(self.network, self.optimizer, losses_of, settings, steps):
                self._average(step)
                self.step = step + 1
                last = self.step == settings.steps
                if self.step % options.log_every == 0 or last:
                    losses = {name: float(part.detach()) for name, part in parts.items()}
                    metrics |= losses
                    self._log(losses)
                if self.step % options.validate_every == 0 or last:
                    found = validate(self.average, views, self.device)
                    metrics |= found
                    warnings = tuple(collapse_warnings(found))
                    self._log(found | {"alarms": float(len(warnings))})
                if last or time.monotonic() - self._saved > options.checkpoint_every_s:
                    self._save()
                on_progress(self.step, settings.steps, dict(metrics), warnings)
        trained: KeypointNetwork = self.average
        return trained

    @torch.no_grad()
    def _average(self, step: int) -> None:
        decay = min(AVERAGE_DECAY, (1.0 + step) / (10.0 + step))
        for mean, value in zip(self.average.state_dict().values(), self.network.state_dict().values(), strict=True):
            if mean.is_floating_point():
                mean.lerp_(value, 1.0 - decay)
            else:
                mean.copy_(value)

    def _resume(self) -> None:
        path = self.folder / CHECKPOINT_FILE
        content = read_state(path, CHECKPOINT_FORMAT)
        if content is None:
            return
        fixed = self.settings.model_dump(mode="json") | {"steps": content.get("settings", {}).get("steps")}
        if "network" not in content or content["settings"] != fixed:
            raise InputError(f"{path}: belongs to a run with other settings; give the same or another --output")
        if content["examples"] != self._examples:
            raise InputError(
                f"{path}: was trained on other images, by another teacher or from another start; give another --output"
            )
        if content["step"] > self.settings.steps:
            raise InputError(
                f"{path}: has {content['step']} steps already, more than {self.settings.steps}; give another --output"
            )
        self.network.load_state_dict(_tensors(content["network"]))
        self.average.load_state_dict(_tensors(content["average"]))
        restore_optimizer_state(self.optimizer, _tensors(content["optimizer"]))
        self.step = content["step"]

    def _save(self) -> None:
        content = {
            "step": self.step,
            "settings": self.settings.model_dump(mode="json"),
            "examples": self._examples,
            "network": _arrays(self.network.state_dict()),
            "average": _arrays(self.average.state_dict()),
            "optimizer": _arrays(get_optimizer_state(self.optimizer)),
        }
        with writing(self.folder / CHECKPOINT_FILE):
            write_state(self.folder / CHECKPOINT_FILE, CHECKPOINT_FORMAT, content)
        self._saved = time.monotonic()

    def _log(self, metrics: Mapping[str, float]) -> None:
        path = self.folder / PROGRESS_FILE
        with writing(path), path.open("a", newline="", encoding="utf-8") as file:
            rows = csv.writer(file)
            if not file.tell():
                rows.writerow(("step", "name", "value"))
            rows.writerows((self.step, name, f"{value:.6g}") for name, value in metrics.items())


def read_curves(path: Path) -> dict[str, Curve]:
    """Curves from the log of a run; of a step that was repeated, the later values count."""
    values: dict[str, dict[int, float]] = {}
    try:
        with path.open(newline="", encoding="utf-8") as file:
            for row in csv.DictReader(file):
                values.setdefault(row["name"], {})[int(row["step"])] = float(row["value"])
    except (OSError, KeyError, ValueError, TypeError) as error:
        raise InputError(f"{path}: is not a log of a training run ({error})") from error
    return {name: (sorted(points), [points[step] for step in sorted(points)]) for name, points in values.items()}


def _arrays(tensors: Mapping[str, Tensor]) -> State:
    return {name: tensor.detach().cpu().numpy() for name, tensor in tensors.items()}


def _tensors(arrays: Mapping[str, Any]) -> dict[str, Tensor]:
    return {name: torch.from_numpy(array) for name, array in arrays.items()}
