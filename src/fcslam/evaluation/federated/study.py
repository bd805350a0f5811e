"""Is training together as good as training in one place? Central, federated and local-only training, compared.

All begin from the same weights, and every network that is compared saw the same number of samples. Each is exported and
measured on the same pairs of views of images that nobody trained on; robots' own networks share them out. Whatever is
finished is kept, so a study can be interrupted. What is compared first, central, local and the first arm, is trained
first. Several processes may work on one study.
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
from fcslam.evaluation.federated.arms import (
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
from fcslam.evaluation.federated.pairs import (
    MEASURES,
    MOST_POINTS,
    DetectedFeatures,
    detect_features,
    held_out_pairs,
    measure_pair,
)
from fcslam.features.detector import OnnxConfig, OnnxDetector
from fcslam.federated.codec import weights_to_network
from fcslam.federated.initial_weights import prepare_initial_weights
from fcslam.federated.settings import FederatedSettings
from fcslam.federated.weights import Weights
from fcslam.learning.arrays import read_arrays, write_arrays
from fcslam.learning.export import export_onnx
from fcslam.learning.images import ImageFile, find_images
from fcslam.learning.network import KeypointNetwork
from fcslam.learning.pairs import ViewPair
from fcslam.learning.stages import TrainingImages, keypoint_response, read_labelled_images
from fcslam.learning.trainer import ExecutionOptions, TrainingProgress
from fcslam.records import FloatArray

TEST_SHARE: Final = 0.25
"""Images of each robot that nobody trains on, chosen by their names, with those that training validates on."""
STUDY_FILE: Final = "study.yaml"


class StudySettings(Settings):
    """A study."""

    federated: FederatedSettings = Field(default_factory=FederatedSettings, description="of every arm")
    start: Path | None = Field(
        default=None, description="checkpoint or detector.onnx that all begin from; without one, synthetic shapes"
    )
    arms: dict[str, Arm] = Field(default_factory=lambda: {"federated": Arm()}, description="by name")
    seeds: int = Field(default=3, ge=1, description="each trains anew, from the same start")
    local_seeds: int | None = Field(
        default=None, ge=0, description="so many of them for robots' own networks, which cost most; 0 is none, null all"
    )
    pairs: int = Field(default=500, ge=1, description="pairs of views, shared out among the robots' held-out images")
    images: int = Field(default=400, ge=4, description="at most so many image files of a robot")
    trained: int = Field(default=400, ge=2, description="of those not tested on, at most so many are trained on")


@dataclass(frozen=True, slots=True)
class Study:
    """What is compared, on what, where."""

    robots: Mapping[str, Path]
    """Folders of images by name."""
    folder: Path
    settings: StudySettings
    pace: ExecutionOptions
    watch: Callable[[str, int, int], None]
    """Is told what is done, how much of it, and of how much."""


@dataclass(frozen=True, slots=True)
class StudyResults:
    """Everything that was measured."""

    robots: tuple[str, ...]
    owners: tuple[int, ...]
    """For each pair the number of the robot whose image it is."""
    measured: Mapping[str, FloatArray]
    """By arm: shape (seeds, networks, pairs, measures). ``local`` and ``alone`` have a network for each robot, all the
    others one; a pair is shown to one of them only, the rest have NaN there. An arm may have fewer seeds than central,
    and robots' own networks may be missing.
    """


def run_study(study: Study) -> StudyResults:
    """Train and measure whatever is not yet measured.

    Raises:
        EvaluationError: the folder is another study's, or an arm has a name that cannot be.
        TrainingError: a robot has too few images.
        OutputError: something cannot be written.
    """
    for name in study.settings.arms:
        if name.split("-")[0] in (START, CENTRAL, LOCAL, ALONE) or not name.replace("-", "").isalnum():
            raise EvaluationError(f"{name}: an arm of a study needs another name")
    with _locked(study.folder / "study.lock", patient=True):  # who begins at the same time reads all of it
        _claim(study)
    share = -(-study.settings.pairs // len(study.robots))
    pairs = [pair for robot in study.robots for pair in held_out_pairs(robot, _files(study, robot)[1], share)]
    files = _files_of_arms(study)
    missing = [(name, seed, file) for name, places in files.items() for seed, file in enumerate(places, start=1)]
    common: SharedInputs | None = None
    # What another process is at is left to it; when there is nothing else to do it is waited for, or taken over.
    for patient in (False, True):
        for name, seed, file in missing:
            with _locked(file.with_suffix(".lock"), patient) as mine:
                if mine and not file.exists():
                    common = common or _shared_inputs(study, pairs)
                    networks = _trained(_seed_context(study, common, seed), name, study.settings.arms)
                    write_arrays(file, {"measures": _measured(networks, pairs, common, seed, study)})
    owners = tuple(index for index in range(len(study.robots)) for _ in range(share))
    measured = {name: np.stack([read_arrays(file)["measures"] for file in places]) for name, places in files.items()}
    return StudyResults(tuple(study.robots), owners, measured)


def _files_of_arms(study: Study) -> dict[str, list[Path]]:
    """Where what is measured of each arm is kept, by seed."""
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
def _locked(path: Path, patient: bool) -> Iterator[bool]:
    """Whether no other process is in here with the same file; if ``patient``, it is waited for."""
    mine = True
    with ExitStack() as stack:
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            file = stack.enter_context(path.open("w", encoding="utf-8"))
            fcntl.flock(file, fcntl.LOCK_EX if patient else fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            mine = False
        except OSError as error:
            raise OutputError(f"{path}: cannot be written ({error})") from error
        yield mine


def _trained(ground: SeedContext, name: str, arms: Mapping[str, Arm]) -> list[KeypointNetwork]:
    if name == START:
        return [weights_to_network(ground.start, ground.settings.training.encoder)]
    if name == CENTRAL:
        return train_central(ground)
    return train_arm(ground, name, arms[name]) if name in arms else train_locally(ground, name)


def _claim(study: Study) -> None:
    """Make the folder this study's, or see that it is; arms and seeds may be added to a study."""
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
                raise EvaluationError(f"{path}: is of another study; name another folder")
        path.write_text(robots + dump(settings), encoding="utf-8")
    except OSError as error:
        raise OutputError(f"{study.folder}: cannot be used as the output folder ({error})") from error


@dataclass(frozen=True, slots=True)
class SharedInputs:
    """What all seeds share."""

    start: Weights
    images: Mapping[str, TrainingImages]
    """By robot, labelled by the start."""
    former: Sequence[DetectedFeatures]
    """What the start finds in the first view of each pair."""


def _shared_inputs(study: Study, pairs: Sequence[ViewPair]) -> SharedInputs:
    training = study.settings.federated.client_training()

    def watch(stage: str, status: TrainingProgress) -> None:
        study.watch(stage, status.step, status.steps)

    device = torch.device(study.pace.device)
    images: dict[str, TrainingImages] = {}
    with _locked(study.folder / "common.lock", patient=True):
        start = prepare_initial_weights(study.settings.start, study.folder, study.settings.federated, study.pace, watch)
        network = weights_to_network(start, training.encoder)
        labeller = keypoint_response(network.to(device), device)
        for robot in study.robots:
            files = _files(study, robot)[0]
            images[robot] = read_labelled_images(files, study.folder / "labels", training, labeller, None, watch)
    detector = _detector(network)
    return SharedInputs(start, images, [detect_features(detector, pair.views[0]) for pair in pairs])


def _seed_context(study: Study, common: SharedInputs, seed: int) -> SeedContext:
    def told(name: str, done: int, of: int) -> None:
        study.watch(f"{name}, seed {seed}", done, of)

    folder = study.folder / f"seed{seed}"
    return SeedContext(study.settings.federated, seed, common.start, common.images, folder, study.pace, told)


def _files(study: Study, robot: str) -> tuple[list[ImageFile], list[ImageFile]]:
    """A robot's image files, to train and to test on, spread over all it has."""
    some = _spread(find_images([study.robots[robot]]), study.settings.images)
    tests = [file for file in some if zlib.crc32(file.name.encode()) < TEST_SHARE * 2**32]
    return _spread([file for file in some if file not in tests], study.settings.trained), tests


def _spread(files: Sequence[ImageFile], most: int) -> list[ImageFile]:
    step = max(len(files) / most, 1.0)
    return [files[int(index * step)] for index in range(min(len(files), most))]


def _measured(
    networks: Sequence[KeypointNetwork], pairs: Sequence[ViewPair], common: SharedInputs, seed: int, study: Study
) -> FloatArray:
    """Shape (networks, pairs, measures): several networks take turns, so that all together cost what one does."""
    detectors = [_detector(network) for network in networks]
    measures = np.full((len(detectors), len(pairs), len(MEASURES)), np.nan)
    for index, pair in enumerate(pairs):
        turn = (index + seed) % len(detectors)
        measures[turn, index] = measure_pair(detectors[turn], pair, common.former[index])
        study.watch("measuring", index + 1, len(pairs))
    return measures


def _detector(network: KeypointNetwork) -> OnnxDetector:
    """A network as robots run it, exported."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "detector.onnx"
        export_onnx(network, path)
        return OnnxDetector(OnnxConfig(weights=path, most_features=MOST_POINTS))
