"""Options of a robot's connection to a cloud service."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from fcslam.wire.http_transport import Server

NETWORK = "Network"

Floor = Annotated[str, typer.Option(help="Floor of the building. Places of different floors are never compared.")]
ServerUrl = Annotated[
    str | None,
    typer.Option(
        "--server",
        metavar="URL",
        rich_help_panel=NETWORK,
        help="Address of the cloud, as in https://cloud.example:8443. Separate the addresses of several instances by "
        "commas.",
    ),
]
Credentials = Annotated[
    Path | None,
    typer.Option(
        metavar="FOLDER",
        rich_help_panel=NETWORK,
        help="Folder with the robot's credentials: token, ca.pem (authority that signed the cloud's certificate, "
        "if it is not one of this system), client.pem and client.key (the robot's certificate).",
    ),
]
Budget = Annotated[
    float | None,
    typer.Option(
        "--budget-kBps",
        min=0.1,
        rich_help_panel=NETWORK,
        help="Limit of the uplink, in kB per second of the recording. Keyscans, constraints, tags and fixes are always "
        "sent; places are sent with fewer descriptors or left out.",
    ),
]


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
