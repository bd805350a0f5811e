"""`fcslam federate serve`: the server of a fleet on several machines."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from fcslam.cli.federate.options import (
    Ca,
    Certificate,
    Insecure,
    Key,
    LocalSteps,
    Public,
    Rounds,
    Security,
    ServerAddress,
    SettingsFile,
    Start,
    Strategy,
    federated_settings,
    parse_address,
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
    from collections.abc import Callable

    from rich.console import Console

    from fcslam.cli.progress import ProgressDisplay
    from fcslam.federated.job import FederatedJob


def serve(
    address: ServerAddress,
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
    ca: Ca = None,
    certificate: Certificate = None,
    key: Key = None,
    robot_key: Annotated[
        list[Path] | None,
        typer.Option(help="Public key of a robot that may join. Can be repeated.", rich_help_panel="TLS"),
    ] = None,
    insecure: Insecure = False,
    quick: Quick = False,
    quiet: Quiet = False,
) -> None:
    """Run the server of a fleet: wait for robots at HOST:PORT and train one detector with them.

    Give --ca, --certificate, --key and the --robot-key of each robot; docs/federated.md shows how to make them. Give
    --insecure only in a network that nobody else can reach.
    """
    from fcslam.cli.progress import ProgressDisplay

    settings = federated_settings(config, quick, strategy, rounds, local_steps, seed)
    require_training_libraries("flwr", extra="federated")
    from fcslam.federated import launch
    from fcslam.federated.job import FederatedJob

    security = Security(ca, certificate, key, tuple(robot_key or ()), insecure)
    certificates = security.certificates()
    where = parse_address(address)
    chosen = compute_budget(device).device
    console = notices(quiet)
    job = FederatedJob(output or new_folder(TRAINING), settings, start, tuple(public or ()))
    with ProgressDisplay(console, f"output: {job.output}") as display:
        launch.serve(job, chosen, where, certificates, security.robot_keys, _watch(display, console, job))
    typer.echo(str(job.output / "detector.onnx"))


def _watch(display: "ProgressDisplay", console: "Console", job: "FederatedJob") -> "Callable[[], None]":
    """Read the run folder; show the rounds, and print a line for each round and each reason to wait."""
    from fcslam.federated.deployed_apps import read_status
    from fcslam.federated.history import ROUNDS_FILE, read_rows

    printed: set[str] = set()

    def watch() -> None:
        state, reason = read_status(job.output)
        rows = read_rows(job.output / ROUNDS_FILE, job.settings.rounds)
        lines = [round_line(row, job.settings.rounds) for row in rows]
        if state == "waiting":
            lines.append(f"waiting: {reason}")
        for line in lines:
            if line not in printed:
                printed.add(line)
                print_line(console, line)
        display.show("rounds", len(rows), job.settings.rounds, state)

    return watch
