"""`fcslam tools federate`: robots train one detector together, and no image leaves its robot."""

import time
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from fcslam.cli.listening import Credentials, check_tls, find_files, listen
from fcslam.cli.options import SettingsFiles, chosen_settings, output_option
from fcslam.cli.output import TRAINING, new_folder, notices, once_printer, print_line
from fcslam.cli.training_options import (
    QUICK_IMAGES,
    TRAINING_OUTPUT,
    Quick,
    Start,
    compute_budget,
    require_training_libraries,
)
from fcslam.errors import InputError, PacketError

if TYPE_CHECKING:
    from rich.console import Console

    from fcslam.cli.progress import ProgressDisplay
    from fcslam.learning.federated.coordinator import RoundRules
    from fcslam.learning.federated.history import RoundReport
    from fcslam.learning.federated.job import ProgressCallbacks
    from fcslam.learning.federated.settings import FederatedSettings
    from fcslam.learning.trainer import TrainingProgress

QUICK: dict[str, object] = {
    "rounds": 3,
    "local_steps": 6,
    "training": {"shape_steps": 30, "pairs": 2, "side_px": 96, "label_copies": 2},
}
"""Settings of ``--quick``: every stage runs, none long enough to learn much."""
MAX_LINES = 1000
"""Different notices that a server prints, so that nobody on the network can fill a log."""
SHOWN = {
    "detector": "loss_detector",
    "contrastive": "loss_contrastive",
    "repeatability": "repeatability",
    "MMA": "mma_3px",
    "revisits": "revisit_recall",
    "places": "places_found",
}
"""Figures of a round: name in its line, and column of ``rounds.csv``."""
Public = Annotated[
    list[Path] | None,
    typer.Option(help="Folder of public images, on which the server evaluates detectors. Can be repeated."),
]

app = typer.Typer(
    no_args_is_help=True, help="Train one detector on the images of many robots. No image leaves its robot."
)


@app.command()
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

    settings = _settings(config, quick)
    require_training_libraries("flwr", extra="federated")
    from fcslam.learning.federated.job import FederatedJob, federate_locally

    console = notices()
    job = FederatedJob(output or new_folder(TRAINING), settings, start, tuple(public or ()), _rules(settings, quick))
    began = time.perf_counter()
    with ProgressDisplay(console, f"output: {job.output}") as display:
        shown, most_images = _callbacks(display, console, settings), QUICK_IMAGES if quick else None
        files = federate_locally(folders, job, compute_budget(quick), shown, most_images)
    for file in files:
        typer.echo(str(file))
    print_line(console, f"{time.perf_counter() - began:.0f} s")


@app.command()
def serve(
    address: Annotated[str, typer.Argument(metavar="HOST:PORT", help="Address to listen on.")],
    *,
    output: Annotated[Path | None, output_option(TRAINING_OUTPUT, TRAINING)] = None,
    config: SettingsFiles = None,
    start: Start = None,
    public: Public = None,
    quick: Quick = False,
    credentials: Credentials = None,
    insecure: Annotated[
        bool,
        typer.Option("--insecure", help="Use neither encryption nor authentication.", rich_help_panel="Credentials"),
    ] = False,
) -> None:
    """Run the server of a fleet: wait for robots at HOST:PORT and train one detector with them.

    Give --credentials with tokens and a certificate. Give --insecure only in a network that nobody else can reach.
    """
    from fcslam.cli.progress import ProgressDisplay

    settings = _settings(config, quick)
    require_training_libraries("flwr", extra="federated")
    from fcslam.learning.federated.fleet_server import open_port, waiting
    from fcslam.learning.federated.job import FederatedJob, run_job
    from fcslam.service.http.authentication import Authenticator, read_tokens

    tokens, certificate, key = find_files(credentials)
    tls = None if certificate is None or key is None else (certificate, key)
    if insecure == (tokens is not None and tls is not None):
        raise InputError(
            "give --credentials with tokens.yaml, cloud.pem and cloud.key, or --insecure in a network of your own"
        )
    check_tls(certificate, key)
    host, port = _host_and_port(address)
    options, console = compute_budget(quick), notices()
    authenticator = Authenticator(None if insecure or tokens is None else read_tokens(tokens))
    job = FederatedJob(output or new_folder(TRAINING), settings, start, tuple(public or ()), _rules(settings, quick))
    with listen(host, port) as listener, ProgressDisplay(console, f"output: {job.output}") as display:
        progress, say = _callbacks(display, console, settings), once_printer(console, MAX_LINES)
        with open_port(listener, None if insecure else tls, authenticator, say) as grid:
            run_job(job, options, progress, grid, waiting(say))
    typer.echo(str(job.output / "detector.onnx"))


@app.command()
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
    require_training_libraries()
    from fcslam.learning.federated.client import RobotClient
    from fcslam.learning.federated.fleet_robot import RobotLink, serve_requests
    from fcslam.wire.checks import check_name
    from fcslam.wire.keys import NO_CREDENTIALS, read_credentials

    if not images.is_dir():
        raise InputError(f"{images}: is not a folder; give the folder of the robot's images")
    robot = images.resolve().name if name is None else name
    try:
        check_name(robot, "robot")
    except PacketError as error:
        raise InputError(f"{error}; give another --name") from error
    found = NO_CREDENTIALS if credentials is None else read_credentials(credentials)
    client = RobotClient(robot, images, output / "labels", compute_budget().device)
    with RobotLink(server, robot, replace(found, own=None)) as link:
        serve_requests(link, client, once_printer(notices()))


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


def _callbacks(display: "ProgressDisplay", console: "Console", settings: "FederatedSettings") -> "ProgressCallbacks":
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


def _settings(chosen: list[str] | None, quick: bool) -> "FederatedSettings":
    from fcslam.config import changed
    from fcslam.learning.federated.settings import FederatedSettings

    base = FederatedSettings()
    return chosen_settings(changed(base, QUICK, "--quick") if quick else base, chosen)


def _rules(settings: "FederatedSettings", quick: bool) -> "RoundRules":
    from fcslam.learning.federated.coordinator import RoundRules
    from fcslam.learning.federated.flower import flower_aggregate

    aggregate = flower_aggregate(settings.strategy)
    return RoundRules(aggregate, judge_every=1) if quick else RoundRules(aggregate)


def _host_and_port(address: str) -> tuple[str, int]:
    """Host and port of ``HOST:PORT``; brackets around an IPv6 address are removed."""
    host, colon, port = address.rpartition(":")
    if not (colon and host.strip("[]") and port.isdecimal() and 0 < int(port) < 65536):
        raise InputError(f"{address}: is not a HOST:PORT")
    return host.strip("[]"), int(port)
