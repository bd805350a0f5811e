"""`fcslam federate serve`: the server of a fleet on several machines."""

from pathlib import Path
from typing import Annotated

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
    Strategy,
    federated_settings,
    parse_address,
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

MAX_LINES = 1000
"""Different notices that are printed, so that nobody on the network can fill a log."""


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
        typer.Option(
            help="Public key of a robot that may join: robot1.pub is that of robot1. Can be repeated.",
            rich_help_panel="TLS",
        ),
    ] = None,
    insecure: Insecure = False,
    quick: Quick = False,
    quiet: Quiet = False,
) -> None:
    """Run the server of a fleet: wait for robots at HOST:PORT and train one detector with them.

    Give --ca, --certificate, --key and the --robot-key of each robot; docs/howto/federated.md shows how to make
    them. Give --insecure only in a network that nobody else can reach.
    """
    from fcslam.cli.progress import ProgressDisplay

    settings = federated_settings(config, quick, strategy, rounds, local_steps, seed)
    require_training_libraries("flwr", extra="federated")
    from fcslam.federated import launch
    from fcslam.federated.identity import RobotAuthenticator, read_robot_keys
    from fcslam.federated.job import FederatedJob

    security = Security(ca, certificate, key, tuple(robot_key or ()), insecure)
    certificates, keys = security.certificates(), read_robot_keys(robot_key or ())
    authenticator = RobotAuthenticator(None if certificates is None else keys)
    where = parse_address(address)
    options = compute_budget(device, quick)
    console, printed = notices(quiet), set[str]()

    def print_once(line: str) -> None:
        if line not in printed and len(printed) < MAX_LINES:
            printed.add(line)
            print_line(console, line)

    job = FederatedJob(output or new_folder(TRAINING), settings, start, tuple(public or ()))
    with ProgressDisplay(console, f"output: {job.output}") as display:
        progress = show_rounds(display, console, settings)
        launch.serve(job, options, where, certificates, authenticator, progress, print_once)
    typer.echo(str(job.output / "detector.onnx"))
