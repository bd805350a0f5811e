"""Is training together as good as training in one place? Central, federated and local-only training, compared.

All begin from the same weights, and every network that is compared saw the same number of samples. Each is measured on
the same pairs of views of images that nobody trained on. Whatever is finished is kept, so a study can be interrupted.
"""

import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
import torch
from pydantic import Field

from fcslam.config import Settings, dump
from fcslam.errors import EvaluationError, OutputError
from fcslam.evaluation.federated_arms import CENTRAL, LOCAL, Arm, Ground, train_central, train_locally, train_together
from fcslam.features.codes import mutual_matches
from fcslam.federated.network import network_of, weights_of
from fcslam.federated.settings import FederatedSettings
from fcslam.learning.arrays import read_arrays, write_arrays
from fcslam.learning.images import ImageFile, find_images, is_usable, read_image
from fcslam.learning.labels import Labels
from fcslam.learning.monitor import MOST_POINTS, detect
from fcslam.learning.network import KeypointNetwork
from fcslam.learning.pairs import Example, Pair, draw_pair
from fcslam.learning.stages import Images, as_detector, gather, train_on_shapes
from fcslam.learning.trainer import Pace, Status
from fcslam.metrics.homography import (
    corner_error,
    estimate_homography,
    inverse,
    match_errors,
    matching_accuracy,
)
from fcslam.metrics.repeatability import in_common_view, repeatability
from fcslam.records import FloatArray

MEASURES: Final = ("homography_3px", "mma_3px", "repeatability")
WITHIN_PX: Final = 3.0
VIEW: Final = (320, 240)
PAIR_SEED: Final = 414
TEST_SHARE: Final = 0.15
"""Images of each robot that nobody trains on, chosen by their names, with those that training validates on."""
STUDY_FILE: Final = "study.yaml"


class StudySettings(Settings):
    """A study."""

    federated: FederatedSettings = Field(default_factory=FederatedSettings, description="of every arm")
    arms: dict[str, Arm] = Field(default_factory=lambda: {"federated": Arm()}, description="by name")
    seeds: int = Field(default=3, ge=1, description="each trains everything anew")
    pairs: int = Field(default=500, ge=1, description="pairs of views, shared out among the robots' held-out images")
    images: int = Field(default=400, ge=4, description="at most so many image files of a robot")


@dataclass(frozen=True, slots=True)
class Study:
    """What is compared, on what, where."""

    robots: Mapping[str, Path]
    """Folders of images by name."""
    folder: Path
    settings: StudySettings
    pace: Pace
    watch: Callable[[str, int, int], None]
    """Is told what is done, how much of it, and of how much."""


@dataclass(frozen=True, slots=True)
class Findings:
    """Everything that was measured."""

    robots: tuple[str, ...]
    owners: tuple[int, ...]
    """For each pair the number of the robot whose image it is."""
    measured: Mapping[str, FloatArray]
    """By arm: shape (seeds, networks, pairs, measures). ``local`` has a network for each robot, all others have one."""


def run_study(study: Study) -> Findings:
    """Train and measure whatever is not yet measured.

    Raises:
        EvaluationError: the folder is another study's, or an arm has a name that cannot be.
        TrainingError: a robot has too few images.
        OutputError: something cannot be written.
    """
    for name in study.settings.arms:
        if name in (CENTRAL, LOCAL, "shapes", "labels") or not name.replace("-", "").isalnum():
            raise EvaluationError(f"{name}: an arm of a study needs another name")
    _claim(study)
    pairs = {robot: held_out_pairs(robot, _files(study, robot)[1], study) for robot in study.robots}
    everything = [pair for own in pairs.values() for pair in own]
    owners = tuple(index for index, own in enumerate(pairs.values()) for _ in own)
    measured: dict[str, list[FloatArray]] = {name: [] for name in (CENTRAL, LOCAL, *study.settings.arms)}
    for seed in range(1, study.settings.seeds + 1):
        place = study.folder / f"seed{seed}"
        ground: Ground | None = None
        for name, rows in measured.items():
            file = place / "measured" / f"{name}.npz"
            if not file.exists():
                ground = ground or _ground(study, seed, place)
                networks = _trained(ground, name, study.settings.arms)
                write_arrays(file, {"measures": np.stack([_measure(each, everything, study) for each in networks])})
            rows.append(read_arrays(file)["measures"])
    return Findings(tuple(study.robots), owners, {name: np.stack(rows) for name, rows in measured.items()})


def _trained(ground: Ground, name: str, arms: Mapping[str, Arm]) -> list[KeypointNetwork]:
    if name == CENTRAL:
        return train_central(ground)
    return train_locally(ground) if name == LOCAL else train_together(ground, name, arms[name])


def _claim(study: Study) -> None:
    """Make the folder this study's, or see that it is."""
    robots = "".join(f"# {robot}: {folder.resolve()}\n" for robot, folder in study.robots.items())
    wanted, path = robots + dump(study.settings), study.folder / STUDY_FILE
    try:
        study.folder.mkdir(parents=True, exist_ok=True)
        if not path.exists():
            path.write_text(wanted, encoding="utf-8")
        elif path.read_text(encoding="utf-8") != wanted:
            raise EvaluationError(f"{path}: is of another study; name another folder")
    except OSError as error:
        raise OutputError(f"{study.folder}: cannot be used as the output folder ({error})") from error


def _ground(study: Study, seed: int, place: Path) -> Ground:
    """The start of a seed, and all images labelled by it."""
    training = study.settings.federated.of_robots().model_copy(update={"seed": seed})

    def watch(stage: str, status: Status) -> None:
        study.watch(f"{stage}, seed {seed}", status.step, status.steps)

    start = weights_of(train_on_shapes(place / "shapes", training, study.pace, watch))
    device = torch.device(study.pace.device)
    labeller = as_detector(network_of(start, training.encoder).to(device), device)
    images: dict[str, Images] = {}
    for robot in study.robots:
        images[robot] = gather(_files(study, robot)[0], place / "labels", training, labeller, None, watch)

    def told(name: str, done: int, of: int) -> None:
        study.watch(f"{name}, seed {seed}", done, of)

    return Ground(study.settings.federated, seed, start, images, place, study.pace, told)


def _files(study: Study, robot: str) -> tuple[list[ImageFile], list[ImageFile]]:
    """A robot's image files, to train and to test on, spread over all it has."""
    files = find_images([study.robots[robot]])
    step = max(len(files) / study.settings.images, 1.0)
    some = [files[int(index * step)] for index in range(min(len(files), study.settings.images))]
    tests = [file for file in some if zlib.crc32(file.name.encode()) < TEST_SHARE * 2**32]
    return [file for file in some if file not in tests], tests


def held_out_pairs(robot: str, files: Sequence[ImageFile], study: Study) -> list[Pair]:
    """Pairs of views of a robot's images, its share of all; always the same.

    Raises:
        EvaluationError: none of the images is usable.
    """
    images = [image for file in files if (image := read_image(file.path)) is not None and is_usable(image)]
    if not images:
        raise EvaluationError(f"{study.robots[robot]}: no usable image there is among the {TEST_SHARE:.0%} to test on")
    unlabelled = Labels(np.zeros((0, 2), np.float32), np.zeros(0, np.float32))
    pairs = []
    for index in range(-(-study.settings.pairs // len(study.robots))):
        rng = np.random.default_rng([PAIR_SEED, zlib.crc32(robot.encode()), index])
        pairs.append(draw_pair(Example(images[index % len(images)], unlabelled), VIEW, 16, 0, rng))
    return pairs


def _measure(network: KeypointNetwork, pairs: Sequence[Pair], study: Study) -> FloatArray:
    """Shape (pairs, measures)."""
    device = torch.device(study.pace.device)
    network = network.to(device).eval()
    rows = []
    for number, pair in enumerate(pairs, start=1):
        rows.append(measure_pair(network, pair, device))
        study.watch("measuring", number, len(pairs))
    return np.array(rows)


def measure_pair(network: KeypointNetwork, pair: Pair, device: torch.device) -> tuple[float, float, float]:
    """``MEASURES`` of one pair: homography right to 3 px at the corners (0 or 1), MMA at 3 px, repeatability."""
    images = [torch.from_numpy(view.image)[None, None].to(device) for view in pair.views]
    (first, first_codes), (second, second_codes) = (detect(network, image) for image in images)
    here, there = in_common_view(first, pair.homography, VIEW), in_common_view(second, inverse(pair.homography), VIEW)
    matches = mutual_matches(first_codes[here], second_codes[there]).pairs
    points = first[here][matches[:, 0]], second[there][matches[:, 1]]
    error = corner_error(estimate_homography(*points), pair.homography, VIEW)
    accuracy = matching_accuracy(match_errors(*points, pair.homography), [WITHIN_PX])
    again = repeatability(first, second, pair.homography, VIEW, MOST_POINTS).repeatability
    return float(error <= WITHIN_PX), float(accuracy[0]), again
