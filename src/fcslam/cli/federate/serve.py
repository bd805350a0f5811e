"""`fcslam tools federate serve`: the server of a fleet on several machines."""

from pathlib import Path
from typing import Annotated

import typer

from fcslam.cli.federate.options import Public, parse_address, round_settings
from fcslam.cli.federate.rounds import show_rounds
from fcslam.cli.listening import Credentials, check_tls, find_files, listen
from fcslam.cli.mission_options import SettingsFiles
from fcslam.cli.options import output_option
from fcslam.cli.output import TRAINING, new_folder, notices, print_line
from fcslam.cli.training_options import TRAINING_OUTPUT, Quick, Start, compute_budget, require_training_libraries

MAX_LINES = 1000
"""Different notices that are printed, so that nobody on the network can fill a log."""


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
    from fcslam.errors import ServiceError

    settings = round_settings(config, quick)
    require_training_libraries("flwr", extra="federated")
    from fcslam.learning.federated.fleet_server import open_port, waiting
    from fcslam.learning.federated.job import FederatedJob, run_job
    from fcslam.service.http.authentication import Authenticator, read_tokens

    tokens, certificate, key = find_files(credentials)
    tls = None if certificate is None or key is None else (certificate, key)
    if insecure == (tokens is not None and tls is not None):
        raise ServiceError(
            "give --credentials with tokens.yaml, cloud.pem and cloud.key, or --insecure in a network of your own"
        )
    check_tls(certificate, key)
    host, port = parse_address(address)
    options = compute_budget(quick)
    console, printed = notices(), set[str]()

    def print_once(line: str) -> None:
        if line not in printed and len(printed) < MAX_LINES:
            printed.add(line)
            print_line(console, line)

    authenticator = Authenticator(None if insecure or tokens is None else read_tokens(tokens))
    job = FederatedJob(output or new_folder(TRAINING), settings, start, tuple(public or ()))
    with listen(host, port) as listener, ProgressDisplay(console, f"output: {job.output}") as display:
        progress = show_rounds(display, console, settings)
        with open_port(listener, None if insecure else tls, authenticator, print_once) as grid:
            run_job(job, options, progress, grid, waiting(print_once))
    typer.echo(str(job.output / "detector.onnx"))
