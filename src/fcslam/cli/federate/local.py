"""`fcslam learn federate local`: a whole fleet in one process."""

import time
from pathlib import Path
from typing import Annotated

import typer

from fcslam.cli.federate.options import (
    LocalSteps,
    Public,
    Rounds,
    SettingsFile,
    Strategy,
    federated_settings,
)
from fcslam.cli.federate.rounds import show_rounds
from fcslam.cli.options import Quiet, output_option
from fcslam.cli.output import TRAINING, new_folder, notices, print_line
from fcslam.cli.training_options import (
    TRAINING_OUTPUT,
    Device,
    Quick,
    Start,
    TrainingSeed,
    compute_budget,
    require_training_libraries,
)


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
    from fcslam.learning.federated.job import FederatedJob
    from fcslam.learning.federated.local import federate_locally

    console = notices(quiet)
    job = FederatedJob(output or new_folder(TRAINING), settings, start, tuple(public or ()))
    began = time.perf_counter()
    with ProgressDisplay(console, f"output: {job.output}") as display:
        files = federate_locally(folders, job, compute_budget(device, quick), show_rounds(display, console, settings))
    for file in files:
        typer.echo(str(file))
    print_line(console, f"{time.perf_counter() - began:.0f} s")
