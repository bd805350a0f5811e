"""Options that several commands share, each declared once, and the examples in their help."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from fcslam.wire.http_transport import Server

Quiet = Annotated[
    bool, typer.Option("--quiet", "-q", help="Print neither progress nor notices on stderr, only errors.")
]
Force = Annotated[bool, typer.Option("--force", "-f", help="Replace the output if it exists.")]
Csv = Annotated[
    Path | None, typer.Option(help="Also write the numbers to this file: as JSON if it ends in .json, else as CSV.")
]
BuildingSeed = Annotated[int, typer.Option("--seed", min=0, help="Seed of the building, the routes and the noise.")]
PathLength = Annotated[
    float | None,
    typer.Option(min=1.0, max=10_000.0, help="Distance that each robot drives, in metres.", show_default="60"),
]
NoCamera = Annotated[bool, typer.Option("--no-camera", help="Simulate LiDARs only. This needs no GL library.")]

Floor = Annotated[str, typer.Option(help="Floor of the building. Places of different floors are never compared.")]
ServerUrl = Annotated[
    str | None,
    typer.Option(
        "--server",
        metavar="URL",
        rich_help_panel="Network",
        help="Address of the cloud, as in https://cloud.example:8443. Separate the addresses of several instances by "
        "commas.",
    ),
]
Credentials = Annotated[
    Path | None,
    typer.Option(
        metavar="FOLDER",
        rich_help_panel="Network",
        help="Folder with the robot's credentials: token, ca.pem (authority that signed the cloud's certificate, "
        "if it is not one of this system), client.pem and client.key (the robot's certificate).",
    ),
]
Budget = Annotated[
    float | None,
    typer.Option(
        "--budget-kBps",
        min=0.1,
        rich_help_panel="Network",
        help="Limit of the uplink, in kB per second of the recording. Keyscans, constraints, tags and fixes are always "
        "sent; places are sent with fewer descriptors or left out.",
    ),
]
WorkersOption = Annotated[
    str,
    typer.Option(
        "--workers",
        metavar="N|ADDRESS",
        help="Processes that verify closures, this one included, or the Dask scheduler of a cluster: "
        "tls://HOST:PORT or tcp://HOST:PORT, with the certificates of Dask's configuration. The result is the same.",
        rich_help_panel="Workers",
    ),
]


def output_option(description: str, parent: str) -> Any:
    """The option ``--output``, whose default is a new folder ``parent/<time>``; see ``output.new_folder``."""
    return typer.Option("--output", "-o", help=description, show_default=f"{parent}/<time>")


def access(server: str | None, credentials: Path | None, budget_kBps: float | None = None) -> "Server | None":
    """The service that a robot sends to; None if none is named.

    Raises:
        InputError: the credentials cannot be read.
    """
    from fcslam.wire.http_transport import Server
    from fcslam.wire.keys import Credentials, read_credentials

    found = Credentials() if credentials is None else read_credentials(credentials)
    if server is None:
        return None
    own = found.own if server.startswith("https:") else None  # a certificate is shown in TLS only
    return Server(server, found.token, found.ca, own, budget_kBps)


def examples(*commands: str) -> str:
    """The epilog of a command's help: one example on each line of at most 78 characters, to be copied as it stands."""
    return "\n\n".join(("Examples:", *commands))  # typer removes single line breaks
