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
    token_file: Annotated[Path | None, typer.Option(help="File with the robot's token.", rich_help_panel=NETWORK)] = (
        None
    )
    ca: Annotated[
        Path | None,
        typer.Option(
            help="Certificate of the authority that signed the cloud's certificate (PEM).",
            show_default="the authorities of this system", rich_help_panel=NETWORK,
        ),
    ] = None  # fmt: skip
    certificate: Annotated[
        Path | None,
        typer.Option(help="The robot's certificate (PEM), which replaces the token.", rich_help_panel=NETWORK),
    ] = None
    key: Annotated[Path | None, typer.Option(help="Private key of --certificate (PEM).", rich_help_panel=NETWORK)] = (
        None
    )

    def access(self) -> "Server | None":
        """The service; None if none is named.

        Raises:
            InputError: the token cannot be read, or the certificate or its key is missing.
        """
        from fcslam.errors import InputError
        from fcslam.wire.http_transport import Server
        from fcslam.wire.keys import read_token

        if (self.certificate is None) != (self.key is None):
            raise InputError("--certificate and --key belong together; give both or neither")
        own = None if self.certificate is None or self.key is None else (self.certificate, self.key)
        token = None if self.token_file is None else read_token(self.token_file)
        return None if self.server is None else Server(self.server, token, self.ca, own)


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
