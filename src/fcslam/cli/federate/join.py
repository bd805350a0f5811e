"""`fcslam tools federate join`: one robot of a fleet on several machines."""

from pathlib import Path
from typing import Annotated

import typer

from fcslam.cli.output import notices, print_line
from fcslam.cli.training_options import compute_budget, require_training_libraries


def join(
    server: Annotated[str, typer.Argument(metavar="URL", help="Address of the server, as in https://server.lab:8000.")],
    images: Annotated[Path, typer.Argument(help="Folder of the robot's images. They stay on this machine.")],
    *,
    output: Annotated[
        Path, typer.Option("--output", "-o", help="Folder for the robot's labels; keep it between starts.")
    ],
    name: Annotated[
        str | None,
        typer.Option(help="Name of the robot, as in its token.", show_default="that of the folder of images"),
    ] = None,
    credentials: Annotated[
        Path | None,
        typer.Option(
            metavar="FOLDER",
            help="Folder with the robot's credentials: token, and ca.pem if it is needed to trust the server.",
        ),
    ] = None,
) -> None:
    """Join a fleet as one robot: train on local images whenever the server asks; Ctrl-C stops.

    The robot runs the installed fcslam and no program of the server.
    """
    require_training_libraries("flwr", extra="federated")
    from fcslam.errors import PacketError, TrainingError
    from fcslam.learning.federated.client import RobotClient
    from fcslam.learning.federated.client_app import build_client_app
    from fcslam.learning.federated.fleet_robot import RobotLink, serve_requests
    from fcslam.wire.checks import check_name
    from fcslam.wire.keys import Credentials, read_credentials

    if not images.is_dir():
        raise TrainingError(f"{images}: is not a folder; give the folder of the robot's images")
    robot = images.resolve().name if name is None else name
    try:
        check_name(robot, "robot")
    except PacketError as error:
        raise TrainingError(f"{error}; give another --name") from error
    console, printed = notices(), set[str]()

    def print_once(line: str) -> None:
        if line not in printed:
            printed.add(line)
            print_line(console, line)

    found = Credentials() if credentials is None else read_credentials(credentials)
    client = RobotClient(robot, images, output / "labels", compute_budget().device)
    with RobotLink(server, robot, found.token, found.ca) as link:
        serve_requests(link, build_client_app(client), print_once)
