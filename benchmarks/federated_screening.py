"""Screening of updates by direction and by batch statistics: what honest robots differ by, and what is refused.

    python benchmarks/federated_screening.py

Needs fcslam[federated] and the image sets. Six robots with ten images each, of three places and in different light
(dark, hazy, noisy, or as they were taken), train for some rounds from the bundled detector. Then every group of four,
five and six of the updates of a round is screened: as it is, and with one or two updates whose sign is flipped.
"""

import itertools
import tempfile
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import common
import cv2
import numpy as np
from numpy.typing import NDArray

from fcslam.features.detector import BUNDLED_NETWORK

if TYPE_CHECKING:
    from fcslam.learning.federated.weights import Weights

    Round = tuple[Weights, dict[str, Weights]]
    """The weights that were sent, and those that came back, by robot."""

Image = NDArray[np.uint8]
IMAGES = 10
LONGEST_SIDE_PX = 480
PLACES = ("ie_tower/floor22", "camvid/0016E5", "coco_subset/train2017")
GROUPS = {"robots": "", "flipped": "", "groups": "d", "flipped refused, %": ".1f", "honest refused": "d"}


def noisy(image: Image) -> Image:
    noise = np.random.default_rng(1).normal(0.0, 15.0, image.shape)
    return np.clip(image + noise, 0, 255).astype(np.uint8)


ROBOTS: Mapping[str, tuple[str, int, Callable[[Image], Image]]] = {
    "tower": (PLACES[0], 0, lambda image: image),
    "town": (PLACES[1], 0, lambda image: image),
    "photos": (PLACES[2], 0, lambda image: image),
    "dark": (PLACES[0], 5, lambda image: (0.3 * image).astype(np.uint8)),
    "haze": (PLACES[1], 5, lambda image: (0.4 * image + 140).astype(np.uint8)),
    "noisy": (PLACES[2], 20, noisy),
}
"""Folder, first image and look of each robot."""


def write_images(vision: Path, robot: str, seed: int, folder: Path) -> Path:
    place, first, look = ROBOTS[robot]
    folder.mkdir(parents=True)
    files = sorted(path for path in (vision / place).rglob("*") if path.suffix.lower() in (".png", ".jpg"))
    for number, file in enumerate(files[first + seed :: max(1, len(files) // 40)][:IMAGES]):
        image = cv2.imread(str(file), cv2.IMREAD_GRAYSCALE)
        scale = LONGEST_SIDE_PX / max(image.shape)
        small = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
        cv2.imwrite(str(folder / f"{number}.png"), look(small))
    return folder


def honest_rounds(vision: Path, seed: int, count: int, folder: Path) -> Iterator["Round"]:
    """Rounds in which the weights of all robots are averaged."""
    from fcslam.learning.federated.client import RobotClient, seeded_noise
    from fcslam.learning.federated.initial_weights import prepare_initial_weights
    from fcslam.learning.federated.settings import FederatedSettings
    from fcslam.learning.settings import TrainingSettings
    from fcslam.learning.trainer import ExecutionOptions

    settings = FederatedSettings(rounds=40, training=TrainingSettings(label_copies=2, pairs=2, seed=seed))
    fleet: list[RobotClient] = [
        RobotClient(
            name, write_images(vision, name, seed, folder / name), folder / "labels" / name, seeded_noise(name, 1)
        )
        for name in ROBOTS
    ]
    weights = prepare_initial_weights(
        BUNDLED_NETWORK, folder / "run", settings, ExecutionOptions(), lambda _stage, _progress: None
    )
    for number in range(count):
        updates = {robot.name: robot.train(weights, number, "run", settings).weights for robot in fleet}
        yield weights, updates
        stacked = {name: [update[name] for update in updates.values()] for name in weights}
        weights = {name: np.mean(arrays, axis=0).astype(np.float32) for name, arrays in stacked.items()}


def flipped(update: "Weights", sent: "Weights") -> "Weights":
    """The parameters of an update with the opposite sign; its batch statistics stay."""
    from fcslam.learning.federated.weights import apply_update, trained_names, update_vector

    names = trained_names(sent, frozen_statistics=True)
    opposite = apply_update(sent, -update_vector(update, sent, names), names)
    return {**update, **{name: opposite[name] for name in names}}


def screened(rounds: list["Round"], robots: int, attackers: int) -> tuple[object, ...]:
    from fcslam.learning.federated.screening import screen
    from fcslam.learning.federated.settings import ScreeningSettings

    rng = np.random.default_rng(0)
    groups = caught = lost = 0
    for sent, updates in rounds:
        for group in itertools.combinations(updates, robots):
            bad = set(rng.choice(group, attackers, replace=False).tolist())
            sample = {name: flipped(updates[name], sent) if name in bad else updates[name] for name in group}
            refused = set(screen(sample, sent, ScreeningSettings()))
            groups, caught, lost = groups + 1, caught + len(refused & bad), lost + len(refused - bad)
    return robots, attackers, groups, 100.0 * caught / (groups * attackers) if attackers else float("nan"), lost


def main() -> None:
    parser = common.options(__doc__)
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--rounds", type=int, default=8)
    chosen = parser.parse_args()
    try:
        import flwr  # noqa: F401
        import torch
    except ImportError:
        print("skipped: needs fcslam[federated]")
        return
    from fcslam.learning.federated.screening import statistics_distances

    vision = common.recordings(*PLACES, kind="vision")
    torch.set_num_threads(1)
    report = common.Report(__file__, __doc__, chosen)
    rounds: list[Round] = []
    with tempfile.TemporaryDirectory() as place:
        for seed in range(1, chosen.seeds + 1):
            rounds += honest_rounds(vision, seed, chosen.rounds, Path(place) / str(seed))
    distances = [found for _, updates in rounds for found in statistics_distances(list(updates.values()))]
    largest = max(float(np.sqrt(np.mean(found**2))) for found in distances)
    worst = max(float(found.max()) for found in distances)
    report.say(f"Batch statistics of honest robots: at most {largest:.2f} from the median, {worst:.2f} in a channel.")
    rows = [screened(rounds, *group) for group in ((4, 0), (4, 1), (5, 1), (6, 1), (6, 2))]
    report.table(f"Screening in {len(rounds)} rounds", GROUPS, rows)
    report.write()


if __name__ == "__main__":
    main()
