"""`fcslam federate local`: a whole fleet in one process."""

import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from fcslam.cli.federate.options import (
    LocalSteps,
    Public,
    Rounds,
    SettingsFile,
    Start,
    Strategy,
    federated_settings,
)
from fcslam.cli.federate.rounds import round_line
from fcslam.cli.options import Quiet, output_option
from fcslam.cli.output import TRAINING, new_folder, notices, print_line
from fcslam.cli.training_options import (
    TRAINING_OUTPUT,
    Device,
    Quick,
    TrainingSeed,
    compute_budget,
    require_training_libraries,
)

if TYPE_CHECKING:
    from rich.console import Console

    from fcslam.cli.progress import ProgressDisplay
    from fcslam.federated.history import RoundReport
    from fcslam.federated.job import ProgressCallbacks
    from fcslam.federated.settings import FederatedSettings
    from fcslam.learning.trainer import TrainingProgress


def local(
    folders: Annotated[
        list[Path], typer.Argument(help="Folders of images, one for each robot. The folder names the robot.")
    ],
    *,
    output: Annotated[Path | None, output_option(TRAINING_OUTPUT, TRAINING)] = None,
    config: SettingsFile = None,
    start: Start = None,
    public: Public = None,
    strategy: Strategy = None,
    rounds: Rounds = None,
    local_steps: LocalSteps = None,
    seed: TrainingSeed = None,
    device: Device = "auto",
    quick: Quick = False,
    quiet: Quiet = False,
) -> None:
    """Train one detector on the images of several robots, simulated in this process.

    The robots exchange the same messages as on separate machines.
    """
    from fcslam.cli.progress import ProgressDisplay

    settings = federated_settings(config, quick, strategy, rounds, local_steps, seed)
    require_training_libraries("flwr", extra="federated")
    from fcslam.federated.job import FederatedJob
    from fcslam.federated.local import federate_locally

    console = notices(quiet)
    job = FederatedJob(output or new_folder(TRAINING), settings, start, tuple(public or ()))
    began = time.perf_counter()
    with ProgressDisplay(console, f"output: {job.output}") as display:
        files = federate_locally(folders, job, compute_budget(device, quick), _watches(display, console, settings))
    for file in files:
        typer.echo(str(file))
    print_line(console, f"{time.perf_counter() - began:.0f} s")


def _watches(display: "ProgressDisplay", console: "Console", settings: "FederatedSettings") -> "ProgressCallbacks":
    """Show the stages before the rounds, the rounds and the local training in them; print a line for each round."""
    from fcslam.federated.job import ProgressCallbacks

    def stage(name: str, status: "TrainingProgress") -> None:
        display.show(name, status.step, status.steps)

    def steps(robot: str, done: int) -> None:
        display.show("local training", done, settings.local_steps, robot)

    def rounds(report: "RoundReport") -> None:
        display.show("rounds", report.round_number, settings.rounds)
        print_line(console, round_line(report.row(), settings.rounds))

    return ProgressCallbacks(stage, steps, rounds)
