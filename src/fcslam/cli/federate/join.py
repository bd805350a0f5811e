"""`fcslam federate join`: one robot of a fleet on several machines."""

from pathlib import Path
from typing import Annotated

import typer

from fcslam.cli.federate.options import Ca, Insecure, ServerAddress, check_robot_security, parse_address
from fcslam.cli.options import Quiet
from fcslam.cli.output import notices, print_line
from fcslam.cli.training_options import Device, compute_budget, require_training_libraries


def join(
    address: ServerAddress,
    images: Annotated[Path, typer.Argument(help="Folder of the robot's images. They stay on this machine.")],
    *,
    output: Annotated[
        Path, typer.Option("--output", "-o", help="Folder for the robot's labels; keep it between starts.")
    ],
    name: Annotated[
        str | None,
        typer.Option(help="Name of the robot.", show_default="that of --robot-key, or of the folder of images"),
    ] = None,
    device: Device = "auto",
    ca: Ca = None,
    robot_key: Annotated[
        Path | None,
        typer.Option(help="The robot's private key; the server has the public one.", rich_help_panel="TLS"),
    ] = None,
    insecure: Insecure = False,
    quiet: Quiet = False,
) -> None:
    """Join a fleet as one robot: train on local images whenever the server at HOST:PORT asks; Ctrl-C stops.

    The robot runs the installed fcslam and no program of the server. Give --ca and --robot-key;
    docs/howto/federated.md shows how to make them. Give --insecure only in a network that nobody else can reach.
    """
    require_training_libraries("flwr", extra="federated")
    from fcslam.errors import TrainingError
    from fcslam.federated import launch
    from fcslam.federated.client import RobotClient, secret_noise
    from fcslam.federated.identity import RobotIdentity, read_private_key
    from fcslam.federated.messages import MAX_NAME_LENGTH

    if not images.is_dir():
        raise TrainingError(f"{images}: is not a folder; give the folder of the robot's images")
    check_robot_security(ca, robot_key, insecure)
    default_name = images.resolve().name if robot_key is None else robot_key.stem
    robot_name = default_name if name is None else name
    if not (0 < len(robot_name) <= MAX_NAME_LENGTH and robot_name.isprintable()):
        raise TrainingError(
            f"{robot_name!r}: a robot's name has 1 to {MAX_NAME_LENGTH} printable characters; give --name"
        )
    console, printed = notices(quiet), set[str]()

    def print_once(line: str) -> None:
        if line not in printed:
            printed.add(line)
            print_line(console, line)

    identity = RobotIdentity(robot_name, None if robot_key is None else read_private_key(robot_key))
    client = RobotClient(robot_name, images, output / "labels", secret_noise, compute_budget(device).device)
    launch.join(parse_address(address), client, identity, ca, print_once)
