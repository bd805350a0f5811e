"""Compares central, federated and local-only training.

All arms start from the same weights, and the networks that are compared saw the same number of samples. Each network is
exported and measured on the same pairs of views, of images that no arm trains on; the robots' own networks divide the
pairs among them. Finished results are kept, so a study can be interrupted.
"""

import tempfile
import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch

from fcslam.config import parse
from fcslam.features.detector import OnnxConfig, OnnxDetector
from fcslam.learning.export import export_onnx
from fcslam.learning.federated.client import Client, ImageClient, InProcessFleet
from fcslam.learning.federated.coordinator import RULES, Coordinator, CoordinatorHooks, RoundRules
from fcslam.learning.federated.flower import flower_aggregate
from fcslam.learning.federated.initial_weights import prepare_initial_weights
from fcslam.learning.federated.networks import weights_to_network, weights_version
from fcslam.learning.federated.settings import FederatedSettings
from fcslam.learning.federated.weights import Weights
from fcslam.learning.images import ImageFile, find_images
from fcslam.learning.network import KeypointNetwork
from fcslam.learning.pairs import TrainingExample, ViewPair
from fcslam.learning.settings import TrainingSettings
from fcslam.learning.stages import TrainingImages, keypoint_response, label_images, read_images
from fcslam.learning.trainer import ExecutionOptions, TrainingRun
from fcslam.records import FloatArray
from fcslam.storage.files import replacing
from fcslam.untrusted import read_arrays

from .pairs import (
    MEASURES,
    MOST_POINTS,
    DetectedFeatures,
    detect_features,
    held_out_pairs,
    measure_pair,
)
from .poison import Poison, PoisonedClient

START: Final = "start"
"""The initial weights without training."""
CENTRAL: Final = "central"
"""One network on the images of all robots."""
LOCAL: Final = "local"
"""Each robot on its own images, with as many steps as all robots of the fleet have together."""
ALONE: Final = "alone"
"""Each robot on its own images, with as many steps as it has in the fleet."""
TEST_SHARE: Final = 0.25
"""Share of each robot's images that no arm trains on, chosen by their names."""


@dataclass(frozen=True, slots=True)
class Arm:
    """One way to train the fleet."""

    together: bool = True
    """True: federated training; false: central training with as many steps as one robot of the fleet."""
    settings: Mapping[str, Any] = field(default_factory=dict)
    """Federated settings of this arm that differ from those of the study."""
    rules: RoundRules = RULES
    """Of the coordinator; its aggregation is that of the settings."""
    poison: Poison | None = None
    """How the last robot falsifies updates; None: it does not."""
    seeds: int | None = None
    """Number of the study's seeds for which this arm is trained; None for all."""

    def federated(self, common: FederatedSettings, seed: int) -> FederatedSettings:
        """The settings of this arm.

        Raises:
            InputError: ``settings`` names something that is not a setting.
        """
        content = common.model_dump() | dict(self.settings)
        content["training"] = dict(content["training"]) | {"seed": seed}
        return parse(FederatedSettings, content, "an arm of the study")


@dataclass(frozen=True, slots=True)
class Study:
    """A study: what is compared, on which images, and where."""

    robots: Mapping[str, Path]
    """Folders of images by name."""
    folder: Path
    federated: FederatedSettings
    """Settings of every arm."""
    arms: Mapping[str, Arm]
    """By name; no name begins with that of a built-in arm."""
    start: Path | None = None
    """Checkpoint or exported detector from which all arms start; None for the bundled one."""
    seeds: int = 3
    """Repetitions of each arm, from the same start."""
    local_seeds: int = 1
    """Repetitions of the arms ``LOCAL`` and ``ALONE``, which cost most; 0 for none."""
    pairs: int = 500
    """Pairs of views in the test, divided evenly among the robots."""
    images: int = 400
    """Most image files of a robot, for training and test."""
    trained: int = 400
    """Most image files of a robot that are trained on."""
    options: ExecutionOptions = field(default_factory=ExecutionOptions)
    on_progress: Callable[[str, int, int], None] = lambda _name, _done, _total: None
    """Called with what is being done, the amount done, and its total."""


@dataclass(frozen=True, slots=True)
class StudyResults:
    """The measurements of a study."""

    robots: tuple[str, ...]
    owners: tuple[int, ...]
    """For each pair the index in ``robots`` of the robot whose image it shows."""
    measured: Mapping[str, FloatArray]
    """By arm: shape (seeds, networks, pairs, measures). The arms ``local`` and ``alone`` have a
    network for each robot, all others one. Each pair is measured with one network only; the others have
    NaN there. An arm may have fewer seeds than central, and ``local`` and ``alone`` may be missing.
    """


@dataclass(frozen=True, slots=True)
class SharedInputs:
    """Data that all arms and seeds share."""

    start: Weights
    images: Mapping[str, TrainingImages]
    """Training images by robot, labelled by the initial network."""
    legacy: Sequence[DetectedFeatures]
    """Features that the initial network detects in the first view of each pair."""


def run_study(study: Study) -> StudyResults:
    """Train and measure everything that is not measured yet.

    Raises:
        InputError: a robot has no usable test image.
        InputError: a robot has too few images, or the folder belongs to another study.
        InputError: a file cannot be written.
    """
    share = -(-study.pairs // len(study.robots))
    pairs = [pair for robot in study.robots for pair in held_out_pairs(robot, _files(study, robot)[1], share)]
    common: SharedInputs | None = None
    measured = {}
    for name, count in _seeds(study).items():
        values = []
        for seed in range(1, count + 1):
            file = study.folder / f"seed{seed}" / "measured" / f"{name}.npz"
            if not file.exists():
                common = common or _shared_inputs(study, pairs)
                networks = _trained(study, common, name, seed)
                file.parent.mkdir(parents=True, exist_ok=True)
                with replacing(file) as unfinished, unfinished.open("wb") as content:
                    np.savez(content, measures=_measured(networks, pairs, common, seed, study))
            values.append(read_arrays(file)["measures"])
        measured[name] = np.stack(values)
    owners = tuple(index for index in range(len(study.robots)) for _ in range(share))
    return StudyResults(tuple(study.robots), owners, measured)


def _seeds(study: Study) -> dict[str, int]:
    """Repetitions by arm, in the order in which the arms are trained."""
    own = min(study.local_seeds, study.seeds)
    counts = {START: 1, CENTRAL: study.seeds, LOCAL: own, ALONE: own}
    counts |= {name: min(arm.seeds or study.seeds, study.seeds) for name, arm in study.arms.items()}
    return {name: count for name, count in counts.items() if count}


def _files(study: Study, robot: str) -> tuple[list[ImageFile], list[ImageFile]]:
    """A robot's image files for training and for the test, spread evenly over all of its files."""
    some = _spread(find_images([study.robots[robot]]), study.images)
    tests = [file for file in some if zlib.crc32(file.name.encode()) < TEST_SHARE * 2**32]
    return _spread([file for file in some if file not in tests], study.trained), tests


def _spread(files: Sequence[ImageFile], most: int) -> list[ImageFile]:
    step = max(len(files) / most, 1.0)
    return [files[int(index * step)] for index in range(min(len(files), most))]


def _shared_inputs(study: Study, pairs: Sequence[ViewPair]) -> SharedInputs:
    training = study.federated.client_training()

    def on_progress(step: int, steps: int, *_: object) -> None:
        study.on_progress("labels", step, steps)

    device = torch.device(study.options.device)
    start = prepare_initial_weights(study.start, study.folder, training.encoder)
    network = weights_to_network(start, training.encoder)
    labeller = keypoint_response(network.to(device), device)
    images = {
        robot: label_images(
            read_images(_files(study, robot)[0]), study.folder / "labels", training, labeller, None, on_progress
        )
        for robot in study.robots
    }
    detector = _detector(network)
    return SharedInputs(start, images, [detect_features(detector, pair.views[0]) for pair in pairs])


def _trained(study: Study, common: SharedInputs, name: str, seed: int) -> list[KeypointNetwork]:
    """The networks of an arm: one for each robot if the robots' networks differ, else one."""
    if name == START:
        return [weights_to_network(common.start, study.federated.training.encoder)]
    everything = [example for images in common.images.values() for example in images.train]
    if name == CENTRAL:
        return [_centrally(study, common, name, seed, everything, _steps_of(study, seed, len(common.images)))]
    if name in (LOCAL, ALONE):
        training = _steps_of(study, seed, len(common.images) if name == LOCAL else 1)
        return [
            _centrally(study, common, f"{name}-{robot}", seed, images.train, training)
            for robot, images in common.images.items()
        ]
    arm = study.arms[name]
    settings = arm.federated(study.federated, seed)
    if not arm.together:
        return [_centrally(study, common, name, seed, everything, settings.client_training())]
    return [_federated(study, common, name, seed, settings)]


def _federated(
    study: Study, common: SharedInputs, name: str, seed: int, settings: FederatedSettings
) -> KeypointNetwork:
    """Train the network of an arm: the one that could be released at its end."""
    folder, encoder = study.folder / f"seed{seed}" / name, settings.training.encoder
    clients: dict[str, Client] = {
        robot: ImageClient(robot, folder / robot, study.options.device, images=own)
        for robot, own in common.images.items()
    }
    poison = study.arms[name].poison
    if poison is not None:
        robot, client = list(clients.items())[-1]
        clients[robot] = PoisonedClient(client, poison)
    hooks = CoordinatorHooks(
        partial(weights_version, encoder=encoder),
        # Without metrics no version is better than another: the last one counts, as in the other arms.
        on_round=lambda report: study.on_progress(f"{name}, seed {seed}", report.round_number, settings.rounds),
    )
    rules = replace(study.arms[name].rules, aggregate=flower_aggregate(settings.strategy))
    state = Coordinator(InProcessFleet(clients), settings, common.start, folder, hooks, rules).run()
    return weights_to_network(state.average, encoder)


def _steps_of(study: Study, seed: int, shares: int) -> TrainingSettings:
    """Training settings with ``shares`` times the steps of a robot in the fleet."""
    training = study.federated.client_training()
    return training.model_copy(update={"steps": training.steps * shares, "seed": seed})


def _centrally(
    study: Study,
    common: SharedInputs,
    name: str,
    seed: int,
    examples: list[TrainingExample],
    training: TrainingSettings,
) -> KeypointNetwork:
    """Train with the trainer of central training."""
    state = weights_to_network(common.start, training.encoder).state_dict()
    folder = study.folder / f"seed{seed}" / name
    folder.mkdir(parents=True, exist_ok=True)
    quiet = replace(study.options, validate_every=training.steps, log_every=max(training.steps // 20, 1))

    def on_progress(step: int, steps: int, *_: object) -> None:
        study.on_progress(f"{name}, seed {seed}", step, steps)

    return TrainingRun(training, folder, quiet, state).train(examples, examples[:1], on_progress=on_progress)


def _measured(
    networks: Sequence[KeypointNetwork], pairs: Sequence[ViewPair], common: SharedInputs, seed: int, study: Study
) -> FloatArray:
    """Measure networks on the pairs, shape (networks, pairs, measures). Several networks take turns, pair by pair."""
    detectors = [_detector(network) for network in networks]
    measures = np.full((len(detectors), len(pairs), len(MEASURES)), np.nan)
    for index, pair in enumerate(pairs):
        turn = (index + seed) % len(detectors)
        other = detectors[(turn + 1) % len(detectors)]
        measures[turn, index] = measure_pair(detectors[turn], other, pair, common.legacy[index])
        study.on_progress("measuring", index + 1, len(pairs))
    return measures


def _detector(network: KeypointNetwork) -> OnnxDetector:
    """The exported network, as robots run it."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "detector.onnx"
        export_onnx(network, path)
        return OnnxDetector(OnnxConfig(weights=path, most_features=MOST_POINTS))
