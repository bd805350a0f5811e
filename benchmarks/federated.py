"""Federated training against training in one place and against robots that train alone, and against poison and noise.

    FCSLAM_DATA=/path/to/data python benchmarks/federated.py --study FOLDER

Needs `fcslam[federated]` and `fcslam[sim]`. FOLDER holds all that is trained and measured; the same command goes on
where it was interrupted. Five robots that see different things: a floor of a tower, a drive through a town, photographs
from the web, and two simulated ones, by day and with lamps off. All begin from one small detector that was trained on
synthetic shapes and on photographs that no robot has, and is far from what longer training makes of it. Central and
local training do as many steps as all robots together, 500, a robot of a fleet a fifth of these in every arm. Pairs are
drawn from images that no network saw; a robot's own network is shown every fifth of them, in turns over the seeds.

Gap: central minus the arm, in points, on the same pairs and seeds, with 95 % by paired bootstrap over pairs. Closed:
(arm - local) / (central - local), where central - local is clearly above 0. Lost: the same arm or FedAvg without
poison, minus the arm.
"""

import json
import sys
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import common

from fcslam.evaluation.federated import Findings, Study, StudySettings, run_study
from fcslam.learning.trainer import Pace

VISION = {"tower": "ie_tower/floor22", "town": "camvid/0016E5", "photos": "coco_subset/train2017"}
SIMULATED = {"day": "robot_1", "lamp-off": "robot_2"}
SIMULATION = ("--robots", 2, "--seed", 7, "--path-length", 40, "--lighting", "day", "--lighting", "lamp-off")
PUBLIC = "sun_hays80"
"""Photographs that the start is trained on."""
START = {"shape_steps": 400, "steps": 1000, "label_copies": 4, "pairs": 4, "side_px": 128, "points": 160}

TRAINING = {"label_copies": 4, "pairs": 2, "side_px": 128, "points": 160, "learning_rate": 1e-3}
FEDERATED = {"rounds": 5, "local_steps": 20, "training": TRAINING}
TRUSTING = {"screening": {"largest_change": None, "longest": None, "least_agreement": None}}
POISONS = ("scaled", "flipped", "random")
WORST_POISON = "scaled"
ROBUST: dict[str, dict[str, Any]] = {
    "screened": {},
    "median": {"strategy": "fedmedian", **TRUSTING},
    "trimmed": {"strategy": "fedtrimmedavg", **TRUSTING},
    "krum": {"strategy": "krum", "normalisation": "frozen", **TRUSTING},
}
NOISE = {"noise-0003": 3e-4, "noise-001": 1e-3, "noise-003": 3e-3}
"""Multipliers; noise of more than that is longer than all updates together."""
KEPT = {"compatible-3": 3.0, "compatible-30": 30.0}
"""Strengths of the pull to the codes of the start."""
CLIP_NORM = 3.0
SEEDS, PAIRS, IMAGES = 3, 500, 64
FEW: dict[str, Any] = {"seeds": 1}
"""What is beside the point gets one seed."""


def arms() -> dict[str, Any]:
    """What is trained beside central and local, in the order in which it is."""
    return {
        "averaged": {},
        **{f"fedavg-{poison}": {"poison": poison, "settings": TRUSTING, **FEW} for poison in POISONS},
        **{f"{name}-{WORST_POISON}": {"poison": WORST_POISON, "settings": how, **FEW} for name, how in ROBUST.items()},
        **{name: {"settings": {"compatible": strength}, **FEW} for name, strength in KEPT.items()},
        "frozen": {"settings": {"normalisation": "frozen"}, **FEW},
        **{name: {"settings": private(multiplier), **FEW} for name, multiplier in NOISE.items()},
    }


def private(multiplier: float) -> dict[str, Any]:
    """Settings with noise; what is mostly noise would be screened out."""
    privacy = {"clip_norm": CLIP_NORM, "noise_multiplier": multiplier}
    return {"normalisation": "frozen", "privacy": privacy, **TRUSTING}


def main() -> None:
    parser = common.options(__doc__ or "")
    parser.add_argument("--study", type=Path, help="folder of the study; the same one resumes")
    chosen = parser.parse_args()
    if chosen.study is None:
        print("skipped: takes an hour or more; name a folder by --study")
        sys.exit(0)
    folder: Path = chosen.study
    vision = common.recordings(*VISION.values(), PUBLIC, kind="vision")
    folder.mkdir(parents=True, exist_ok=True)
    prepare(vision, folder)
    findings = study(vision, folder)
    print(findings)


def prepare(vision: Path, folder: Path) -> None:
    """The simulated robots and the start, unless they are there."""
    if not (folder / "fleet" / "simulation.yaml").exists():
        common.run_fcslam("simulate", "--output", folder / "fleet", *SIMULATION)
    if not (folder / "start" / "detector.onnx").exists():
        (folder / "start.yaml").write_text(json.dumps(START), encoding="utf-8")
        common.run_fcslam("train", vision / PUBLIC, "--config", folder / "start.yaml", "--output", folder / "start")


def study(vision: Path, folder: Path) -> Findings:
    """Train and measure whatever is missing."""
    import torch

    torch.set_num_threads(1)
    robots = {name: vision / place for name, place in VISION.items()}
    robots |= {name: folder / "fleet" / robot for name, robot in SIMULATED.items()}
    content = {"federated": FEDERATED, "arms": arms(), "seeds": SEEDS, "pairs": PAIRS, "images": IMAGES}
    content["start"] = folder / "start" / "joint" / "checkpoint.npz"
    settings = StudySettings.model_validate(content)

    def watch(name: str, done: int, of: int) -> None:
        if done == of:
            print(f"{datetime.now(UTC):%H:%M:%S} {name}: {of}", flush=True)

    return run_study(Study(robots, folder / "study", settings, Pace(), watch))


if __name__ == "__main__":
    main()
