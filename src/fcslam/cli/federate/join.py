"""`fcslam federate join`: one robot of a fleet on several machines."""

from pathlib import Path
from typing import Annotated

import typer

from fcslam.cli.federate.options import Ca, Certificate, Insecure, Key, Security, ServerAddress, parse_address
from fcslam.cli.options import Quiet
from fcslam.cli.output import notices, print_line
from fcslam.cli.training_options import Device, compute_budget, require_training_libraries


def join(
    address: ServerAddress,
    images: Annotated[Path, typer.Argument(help="Folder of the robot's images. They stay on this machine.")],
    *,
    output: Annotated[
        Path, typer.Option("--output", "-o", help="Folder for the robot's labels and log; keep it between starts.")
    ],
    name: Annotated[
        str | None, typer.Option(help="Name of the robot.", show_default="that of the folder of images")
    ] = None,
    device: Device = "auto",
    ca: Ca = None,
    certificate: Certificate = None,
    key: Key = None,
    robot_key: Annotated[
        Path | None,
        typer.Option(help="The robot's private key; the server has the public one.", rich_help_panel="TLS"),
    ] = None,
    insecure: Insecure = False,
    quiet: Quiet = False,
) -> None:
    """Join a fleet as one robot: train on local images whenever the server at HOST:PORT asks; Ctrl-C stops.

    Give --ca, --certificate, --key and --robot-key; docs/federated.md shows how to make them. Give --insecure only in
    a network that nobody else can reach.
    """
    require_training_libraries("flwr", extra="federated")
    from fcslam.errors import TrainingError
    from fcslam.federated import launch
    from fcslam.federated.messages import MAX_NAME_LENGTH

    if not images.is_dir():
        raise TrainingError(f"{images}: is no folder; give the folder of the robot's images")
    security = Security(ca, certificate, key, () if robot_key is None else (robot_key,), insecure)
    certificates = security.certificates()
    robot_name = images.resolve().name if name is None else name
    if not (0 < len(robot_name) <= MAX_NAME_LENGTH and robot_name.isprintable()):
        raise TrainingError(
            f"{robot_name!r}: a robot's name has 1 to {MAX_NAME_LENGTH} printable characters; give --name"
        )
    robot = {
        "robot": robot_name,
        "images": str(images.resolve()),
        "labels": str((output / "labels").resolve()),
        "device": compute_budget(device).device,
    }
    console, printed = notices(quiet), set[str]()

    def print_reason(reason: str) -> None:
        if reason not in printed:
            printed.add(reason)
            print_line(console, f"waiting: {reason}")

    log_file = output / launch.LOG_FILE
    code = launch.join(parse_address(address), robot, certificates, robot_key, log_file, print_reason)
    if code != 0:
        raise TrainingError(f"{address}: the server does not accept this robot; see {log_file}")
