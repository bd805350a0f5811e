"""Compares central, federated and local-only training.

All arms start from the same weights, and the networks that are compared saw the same number of samples. Each network is
exported and measured on the same pairs of views, of images that no arm trains on; the robots' own networks divide the
pairs among them. Finished results are kept, so a study can be interrupted, and several processes can work on one study.
"""

import fcntl
import tempfile
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
import torch
from pydantic import Field

from fcslam.config import Settings, dump, load
from fcslam.errors import EvaluationError, OutputError
from fcslam.features.detector import OnnxConfig, OnnxDetector
from fcslam.lab.evaluation.federated.arms import (
    ALONE,
    CENTRAL,
    LOCAL,
    START,
    Arm,
    SeedContext,
    train_arm,
    train_central,
    train_locally,
)
from fcslam.lab.evaluation.federated.pairs import (
    MEASURES,
    MOST_POINTS,
    DetectedFeatures,
    detect_features,
    held_out_pairs,
    measure_pair,
)
from fcslam.learning.arrays import write_arrays
from fcslam.learning.export import export_onnx
from fcslam.learning.federated.initial_weights import prepare_initial_weights
from fcslam.learning.federated.networks import weights_to_network
from fcslam.learning.federated.settings import FederatedSettings
from fcslam.learning.federated.weights import Weights
from fcslam.learning.images import ImageFile, find_images
from fcslam.learning.network import KeypointNetwork
from fcslam.learning.pairs import ViewPair
from fcslam.learning.stages import TrainingImages, keypoint_response, read_labelled_images
from fcslam.learning.trainer import ExecutionOptions, TrainingProgress
from fcslam.records import FloatArray
from fcslam.untrusted import read_arrays

TEST_SHARE: Final = 0.25
"""Share of each robot's images that no arm trains on, chosen by their names."""
STUDY_FILE: Final = "study.yaml"


class StudySettings(Settings):
    """Settings of a study."""

    federated: FederatedSettings = Field(
        default_factory=FederatedSettings, description="federated settings of every arm"
    )
    start: Path | None = Field(
        default=None,
        description="checkpoint or detector.onnx from which all arms start; null for training on synthetic shapes",
    )
    arms: dict[str, Arm] = Field(default_factory=lambda: {"federated": Arm()}, description="federated arms by name")
    seeds: int = Field(default=3, ge=1, description="number of repetitions of each arm, from the same start")
    local_seeds: int | None = Field(
        default=None,
        ge=0,
        description="repetitions of the arms local and alone, which cost most; 0 for none, null for all seeds",
    )
    pairs: int = Field(default=500, ge=1, description="pairs of views in the test, divided evenly among the robots")
    images: int = Field(default=400, ge=4, description="most image files of a robot, for training and test")
    trained: int = Field(default=400, ge=2, description="most image files of a robot that are trained on")


@dataclass(frozen=True, slots=True)
class Study:
    """A study: what is compared, on which images, and where."""

    robots: Mapping[str, Path]
    """Folders of images by name."""
    folder: Path
    settings: StudySettings
    options: ExecutionOptions
    on_progress: Callable[[str, int, int], None]
    """Called with what is being done, the amount done, and its total."""


@dataclass(frozen=True, slots=True)
class StudyResults:
    """The measurements of a study."""

    robots: tuple[str, ...]
    owners: tuple[int, ...]
    """For each pair the index in ``robots`` of the robot whose image it shows."""
    measured: Mapping[str, FloatArray]
    """By arm: shape (seeds, networks, pairs, measures). The arms ``local`` and ``alone`` have a network for each robot,
    all others one. Each pair is measured with one network only; the others have NaN there. An arm may have fewer seeds
    than central, and ``local`` and ``alone`` may be missing.
    """


def run_study(study: Study) -> StudyResults:
    """Train and measure everything that is not measured yet.

    Raises:
        EvaluationError: the folder belongs to another study, or an arm has a reserved or malformed name.
        TrainingError: a robot has too few images.
        OutputError: a file cannot be written.
    """
    for name in study.settings.arms:
        if name.split("-")[0] in (START, CENTRAL, LOCAL, ALONE) or not name.replace("-", "").isalnum():
            raise EvaluationError(
                f"{name}: an arm's name has letters, digits and hyphens, and is none of the built-in arms"
            )
    with _locked(
        study.folder / "study.lock", wait=True
    ):  # a process that starts at the same time reads a complete file
        _claim(study)
    share = -(-study.settings.pairs // len(study.robots))
    pairs = [pair for robot in study.robots for pair in held_out_pairs(robot, _files(study, robot)[1], share)]
    files = _files_of_arms(study)
    missing = [(name, seed, file) for name, places in files.items() for seed, file in enumerate(places, start=1)]
    common: SharedInputs | None = None
    # First what no other process works on. Then wait for the others, and take over what they leave unfinished.
    for wait in (False, True):
        for name, seed, file in missing:
            with _locked(file.with_suffix(".lock"), wait) as mine:
                if mine and not file.exists():
                    common = common or _shared_inputs(study, pairs)
                    networks = _trained(_seed_context(study, common, seed), name, study.settings.arms)
                    write_arrays(file, {"measures": _measured(networks, pairs, common, seed, study)})
    owners = tuple(index for index in range(len(study.robots)) for _ in range(share))
    measured = {name: np.stack([read_arrays(file)["measures"] for file in places]) for name, places in files.items()}
    return StudyResults(tuple(study.robots), owners, measured)


def _files_of_arms(study: Study) -> dict[str, list[Path]]:
    """Files of the measurements of each arm, by seed."""
    settings = study.settings
    own = settings.seeds if settings.local_seeds is None else min(settings.local_seeds, settings.seeds)
    seeds = {START: 1, CENTRAL: settings.seeds, LOCAL: own, ALONE: own}
    seeds |= {name: min(arm.seeds or settings.seeds, settings.seeds) for name, arm in settings.arms.items()}
    return {
        name: [study.folder / f"seed{seed}" / "measured" / f"{name}.npz" for seed in range(1, count + 1)]
        for name, count in seeds.items()
        if count
    }


@contextmanager
def _locked(path: Path, wait: bool) -> Iterator[bool]:
    """Whether this process has the lock of the file; ``wait`` for it, or give up if another process has it."""
    mine = True
    with ExitStack() as stack:
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            file = stack.enter_context(path.open("w", encoding="utf-8"))
            fcntl.flock(file, fcntl.LOCK_EX if wait else fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            mine = False
        except OSError as error:
            raise OutputError(f"{path}: cannot be written ({error})") from error
        yield mine


def _trained(context: SeedContext, name: str, arms: Mapping[str, Arm]) -> list[KeypointNetwork]:
    if name == START:
        return [weights_to_network(context.start, context.settings.training.encoder)]
    if name == CENTRAL:
        return train_central(context)
    return train_arm(context, name, arms[name]) if name in arms else train_locally(context, name)


def _claim(study: Study) -> None:
    """Claim the folder for this study, or check that it belongs to it; arms and seeds may be added to a study."""
    robots = "".join(f"# {robot}: {folder.resolve()}\n" for robot, folder in study.robots.items())
    settings, path = study.settings, study.folder / STUDY_FILE
    try:
        study.folder.mkdir(parents=True, exist_ok=True)
        if path.exists():
            before = load(StudySettings, path)
            counts = {"seeds": settings.seeds, "local_seeds": settings.local_seeds}
            known = before.model_copy(update={"arms": before.arms | settings.arms, **counts})
            settings = settings.model_copy(update={"arms": known.arms})
            same = {name: known.arms[name].model_copy(update={"seeds": arm.seeds}) for name, arm in before.arms.items()}
            changed = same != before.arms
            if changed or known != settings or not path.read_text(encoding="utf-8").startswith(robots):
                raise EvaluationError(f"{path}: belongs to another study; give another folder")
        path.write_text(robots + dump(settings), encoding="utf-8")
    except OSError as error:
        raise OutputError(f"{study.folder}: cannot be used as the output folder ({error})") from error


@dataclass(frozen=True, slots=True)
class SharedInputs:
    """Data that all seeds share."""

    start: Weights
    images: Mapping[str, TrainingImages]
    """Training images by robot, labelled by the initial network."""
    legacy: Sequence[DetectedFeatures]
    """Features that the initial network detects in the first view of each pair."""


def _shared_inputs(study: Study, pairs: Sequence[ViewPair]) -> SharedInputs:
    training = study.settings.federated.client_training()

    def on_progress(stage: str, progress: TrainingProgress) -> None:
        study.on_progress(stage, progress.step, progress.steps)

    device = torch.device(study.options.device)
    images: dict[str, TrainingImages] = {}
    with _locked(study.folder / "common.lock", wait=True):
        start = prepare_initial_weights(
            study.settings.start, study.folder, study.settings.federated, study.options, on_progress
        )
        network = weights_to_network(start, training.encoder)
        labeller = keypoint_response(network.to(device), device)
        for robot in study.robots:
            files = _files(study, robot)[0]
            images[robot] = read_labelled_images(files, study.folder / "labels", training, labeller, None, on_progress)
    detector = _detector(network)
    return SharedInputs(start, images, [detect_features(detector, pair.views[0]) for pair in pairs])


def _seed_context(study: Study, common: SharedInputs, seed: int) -> SeedContext:
    def on_progress(name: str, done: int, total: int) -> None:
        study.on_progress(f"{name}, seed {seed}", done, total)

    folder = study.folder / f"seed{seed}"
    return SeedContext(study.settings.federated, seed, common.start, common.images, folder, study.options, on_progress)


def _files(study: Study, robot: str) -> tuple[list[ImageFile], list[ImageFile]]:
    """A robot's image files for training and for the test, spread evenly over all of its files."""
    some = _spread(find_images([study.robots[robot]]), study.settings.images)
    tests = [file for file in some if zlib.crc32(file.name.encode()) < TEST_SHARE * 2**32]
    return _spread([file for file in some if file not in tests], study.settings.trained), tests


def _spread(files: Sequence[ImageFile], most: int) -> list[ImageFile]:
    step = max(len(files) / most, 1.0)
    return [files[int(index * step)] for index in range(min(len(files), most))]


def _measured(
    networks: Sequence[KeypointNetwork], pairs: Sequence[ViewPair], common: SharedInputs, seed: int, study: Study
) -> FloatArray:
    """Measure networks on the pairs, shape (networks, pairs, measures). Several networks take turns, pair by pair."""
    detectors = [_detector(network) for network in networks]
    measures = np.full((len(detectors), len(pairs), len(MEASURES)), np.nan)
    for index, pair in enumerate(pairs):
        turn = (index + seed) % len(detectors)
        measures[turn, index] = measure_pair(detectors[turn], pair, common.legacy[index])
        study.on_progress("measuring", index + 1, len(pairs))
    return measures


def _detector(network: KeypointNetwork) -> OnnxDetector:
    """The exported network, as robots run it."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "detector.onnx"
        export_onnx(network, path)
        return OnnxDetector(OnnxConfig(weights=path, most_features=MOST_POINTS))
