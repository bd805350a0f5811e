"""Shows the rounds of federated training while they run."""

from collections.abc import Mapping
from typing import TYPE_CHECKING

from fcslam.cli.output import print_line

if TYPE_CHECKING:
    from rich.console import Console

    from fcslam.cli.progress import ProgressDisplay
    from fcslam.learning.federated.history import RoundReport
    from fcslam.learning.federated.job import ProgressCallbacks
    from fcslam.learning.federated.settings import FederatedSettings
    from fcslam.learning.trainer import TrainingProgress


def round_line(row: Mapping[str, str], rounds: int) -> str:
    """The line of a row of ``rounds.csv``: robots, figures, traffic and whether the new detector is released."""
    released, returned, judged = row["released"] == "1", row["returned"] == "1", row["score"] != "nan"
    reason = row.get("reason", "")
    outcome = "back to the best" if returned else "not released" if judged or reason else "not judged"
    shown = {
        "detector": "loss_detector",
        "contrastive": "loss_contrastive",
        "repeatability": "repeatability",
        "MMA": "mma_3px",
        "revisits": "revisit_recall",
        "places": "places_found",
    }
    parts = [
        f"round {row['round']}/{rounds}",
        f"{len(row['robots'].split(' | '))} robots",
        *(f"{name} {float(row[column]):.3f}" for name, column in shown.items() if row.get(column)),
        f"down {float(row['bytes_down']) / 1e6:.1f} MB, up {float(row['bytes_up']) / 1e6:.1f} MB",
        f"released {row['version']}" if released else f"{outcome}: {reason}" if reason else outcome,
        *([f"without {row['left_out']}"] if row["left_out"] else []),
    ]
    return "  ".join(parts)


def show_rounds(display: "ProgressDisplay", console: "Console", settings: "FederatedSettings") -> "ProgressCallbacks":
    """Show the stages before the rounds, the rounds and the local training in them; print a line for each round."""
    from fcslam.learning.federated.job import ProgressCallbacks

    def stage(name: str, status: "TrainingProgress") -> None:
        display.show(name, status.step, status.steps)

    def steps(robot: str, done: int) -> None:
        display.show("local training", done, settings.local_steps, robot)

    def rounds(report: "RoundReport") -> None:
        display.show("rounds", report.round_number, settings.rounds)
        print_line(console, round_line(report.row(), settings.rounds))

    return ProgressCallbacks(stage, steps, rounds)
