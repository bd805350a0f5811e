"""`fcslam tools federate local`: a whole fleet in one process."""

import time
from pathlib import Path
from typing import Annotated

import typer

from fcslam.cli.federate.options import Public, round_settings
from fcslam.cli.federate.rounds import show_rounds
from fcslam.cli.mission_options import SettingsFiles
from fcslam.cli.options import output_option
from fcslam.cli.output import TRAINING, new_folder, notices, print_line
from fcslam.cli.training_options import (
    QUICK_IMAGES,
    TRAINING_OUTPUT,
    Quick,
    Start,
    compute_budget,
    require_training_libraries,
)


def local(
    folders: Annotated[
        list[Path], typer.Argument(help="Folders of images, one for each robot. The folder names the robot.")
    ],
    *,
    output: Annotated[Path | None, output_option(TRAINING_OUTPUT, TRAINING)] = None,
    config: SettingsFiles = None,
    start: Start = None,
    public: Public = None,
    quick: Quick = False,
) -> None:
    """Train one detector on the images of several robots, simulated in this process.

    The robots exchange the same messages as on separate machines.
    """
    from fcslam.cli.progress import ProgressDisplay

    settings = round_settings(config, quick)
    require_training_libraries("flwr", extra="federated")
    from fcslam.learning.federated.job import FederatedJob, federate_locally

    console = notices()
    job = FederatedJob(output or new_folder(TRAINING), settings, start, tuple(public or ()))
    began = time.perf_counter()
    with ProgressDisplay(console, f"output: {job.output}") as display:
        shown, most_images = show_rounds(display, console, settings), QUICK_IMAGES if quick else None
        files = federate_locally(folders, job, compute_budget(quick), shown, most_images)
    for file in files:
        typer.echo(str(file))
    print_line(console, f"{time.perf_counter() - began:.0f} s")
