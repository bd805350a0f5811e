"""`fcslam tools federate`: robots train one detector together, and no image leaves its robot."""

import time
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from fcslam.cli.options import SettingsFiles, chosen_settings, output_option
from fcslam.cli.output import TRAINING, new_folder, notices, print_line
from fcslam.cli.training_options import TRAINING_OUTPUT, Start, compute_budget, require_training_libraries

if TYPE_CHECKING:
    from fcslam.learning.federated.rounds import RoundReport

SHOWN = {
    "detector": "loss_detector",
    "contrastive": "loss_contrastive",
    "repeatability": "repeatability",
    "MMA": "mma_3px",
    "revisits": "revisit_recall",
    "places": "places_found",
}
"""Figures of a round: name in its line, and column of ``rounds.csv``."""


def federate(
    folders: Annotated[
        list[Path], typer.Argument(help="Folders of images, one for each robot. The folder names the robot.")
    ],
    *,
    output: Annotated[Path | None, output_option(TRAINING_OUTPUT, TRAINING)] = None,
    config: SettingsFiles = None,
    start: Start = None,
    public: Annotated[
        list[Path] | None,
        typer.Option(help="Folder of public images, on which detectors are evaluated. Can be repeated."),
    ] = None,
) -> None:
    """Train one detector on the images of several robots, simulated in this process. No image leaves its robot.

    The robots of a service train with `fcslam serve --learn`.
    """
    from fcslam.cli.progress import ProgressDisplay
    from fcslam.learning.federated.settings import FederatedSettings

    settings = chosen_settings(FederatedSettings(), config)
    require_training_libraries("flwr", extra="federated")
    from fcslam.learning.federated.coordinator import RoundRules
    from fcslam.learning.federated.flower import flower_aggregate
    from fcslam.learning.federated.job import FederatedJob, federate_locally

    console, rules = notices(), RoundRules(flower_aggregate(settings.strategy))
    where, device = output or new_folder(TRAINING), compute_budget().device
    job = FederatedJob(where, settings, start, tuple(public or ()), rules, device)
    began = time.perf_counter()
    with ProgressDisplay(console, f"output: {job.output}") as display:

        def on_step(robot: str, done: int) -> None:
            display.show("local training", done, settings.local_steps, robot)

        def on_round(report: "RoundReport") -> None:
            display.show("rounds", report.round_number, settings.rounds)
            print_line(console, round_line(report.row(), settings.rounds))

        files = federate_locally(folders, job, on_round, on_step)
    for file in files:
        typer.echo(str(file))
    print_line(console, f"{time.perf_counter() - began:.0f} s")


def round_line(row: Mapping[str, str], rounds: int) -> str:
    """The line of a row of ``rounds.csv``: robots, figures, traffic and whether the new detector is released."""
    released, returned, judged = row["released"] == "1", row["returned"] == "1", row["score"] != "nan"
    reason = row.get("reason", "")
    outcome = "back to the best" if returned else "not released" if judged or reason else "not judged"
    parts = [
        f"round {row['round']}/{rounds}",
        f"{len(row['robots'].split(' | '))} robots",
        *(f"{name} {float(row[column]):.3f}" for name, column in SHOWN.items() if row.get(column)),
        f"down {float(row['bytes_down']) / 1e6:.1f} MB, up {float(row['bytes_up']) / 1e6:.1f} MB",
        f"released {row['version']}" if released else f"{outcome}: {reason}" if reason else outcome,
        *([f"without {row['left_out']}"] if row["left_out"] else []),
    ]
    return "  ".join(parts)
