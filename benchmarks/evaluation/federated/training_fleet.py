"""The five robots of the studies of federated training, a study's run, and its tables. No benchmark itself."""

from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import common

from fcslam.metrics.bootstrap import Interval

if TYPE_CHECKING:
    from .report import ArmReport
    from .study import StudyResults

    Rows = dict[tuple[str, str], ArmReport]
    """By measure and arm."""

VISION = {"tower": "ie_tower/floor22", "town": "camvid/0016E5", "photos": "coco_subset/train2017"}
SIMULATED = {"day": "robot_1", "lamp-off": "robot_2"}
SIMULATION = ("--robots", 2, "--seed", 7, "--path-length", 40, "--lighting", "day", "--lighting", "lamp-off")
TITLES = {"homography_3px": "Homographies right to 3 px, %", "mma_3px": "MMA at 3 px, %"}
GAPS = {"arm": "s", "seeds": "d", "mean": ".1f", "gap": "s", "closed": ".2f", "of alone": ".2f", "worst robot": "s",
        "each seed": "s"}  # fmt: skip


def robots(vision: Path, folder: Path) -> dict[str, Path]:
    """Each robot's folder of images; the simulated ones drive first, unless they have."""
    if not (folder / "fleet" / "simulation.yaml").exists():
        common.run_fcslam("tools", "simulate", "--output", folder / "fleet", *SIMULATION)
    real = {name: vision / place for name, place in VISION.items()}
    return real | {name: folder / "fleet" / robot for name, robot in SIMULATED.items()}


def run(fleet: Mapping[str, Path], folder: Path, content: Mapping[str, Any]) -> "StudyResults":
    """Train and measure whatever is missing of a study in a folder; ``content``: further fields of ``Study``."""
    import torch

    from fcslam.learning.federated.settings import FederatedSettings

    from .study import Arm, Study, run_study

    torch.set_num_threads(1)

    def watch(name: str, done: int, of: int) -> None:
        if done == of:
            print(f"{datetime.now(UTC):%H:%M:%S} {name}: {of}", flush=True)

    settings = FederatedSettings.model_validate(content["federated"])
    arms = {name: Arm(**arm) for name, arm in content["arms"].items()}
    return run_study(Study(fleet, folder, **{**content, "federated": settings, "arms": arms}, on_progress=watch))


def compare(findings: "StudyResults", against: str) -> "Rows":
    """Every arm by every measure, compared to one."""
    from .report import report

    return {(row.measure, row.arm): row for row in report(findings, against=against)}


def gap_row(row: "ArmReport") -> tuple[object, ...]:
    """As ``GAPS`` has it."""
    worst = f"{row.worst_robot} {100 * row.worst_gap:.1f}"
    seeds = " ".join(f"{100 * mean:.1f}" for mean in row.seeds)
    return row.arm, len(row.seeds), 100 * row.mean, points(row.gap), row.closed, row.closed_alone, worst, seeds


def points(interval: Interval) -> str:
    """A share's interval in points."""
    return f"{100 * interval.mean:.1f} [{100 * interval.low:.1f}, {100 * interval.high:.1f}]"
