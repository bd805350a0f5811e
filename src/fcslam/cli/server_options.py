"""Options of a robot's connection to a cloud service."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from fcslam.wire.http_transport import Server

NETWORK = "Network"

Floor = Annotated[str, typer.Option(help="Floor of the building. Places of different floors are never compared.")]


@dataclass(frozen=True)
class AccessFlags:
    """Which service, and how a robot shows it who it is."""

    server: Annotated[
        str | None,
        typer.Option(
            metavar="URL", rich_help_panel=NETWORK,
            help="Address of the cloud, as in https://cloud.example:8443, or those of its instances with commas "
            "between them.",
        ),
    ] = None  # fmt: skip
    credentials: Annotated[
        Path | None,
        typer.Option(
            metavar="FOLDER", rich_help_panel=NETWORK,
            help="Folder with the robot's credentials: token, ca.pem (authority that signed the cloud's certificate, "
            "if it is not one of this system), client.pem and client.key (the robot's certificate).",
        ),
    ] = None  # fmt: skip

    def access(self) -> "Server | None":
        """The service; None if none is named.

        Raises:
            InputError: the credentials cannot be read.
        """
        from fcslam.wire.http_transport import Server
        from fcslam.wire.keys import Credentials, read_credentials

        found = Credentials() if self.credentials is None else read_credentials(self.credentials)
        if self.server is None:
            return None
        own = found.own if self.server.startswith("https:") else None  # a certificate is shown in TLS only
        return Server(self.server, found.token, found.ca, own)


@dataclass(frozen=True)
class ServerFlags(AccessFlags):
    """The service that a robot sends to, and how much it may send."""

    budget_kbps: Annotated[
        float | None,
        typer.Option(
            "--budget-kBps", min=0.1, rich_help_panel=NETWORK,
            help="Limit of the uplink, in kB per second of the recording. Keyscans and constraints are always sent; "
            "places are sent with fewer descriptors or left out.",
        ),
    ] = None  # fmt: skip

    def access(self) -> "Server | None":
        """As in AccessFlags, with the limit."""
        access = super().access()
        return None if access is None else replace(access, budget_kbps=self.budget_kbps)
