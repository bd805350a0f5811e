"""Options of a federated run, of which each subcommand uses those that it needs."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from fcslam.federated.settings import FederatedSettings
    from fcslam.federated.tls import Address, Certificates

QUICK = {"rounds": 3, "local_steps": 6, "judge_every": 1}
QUICK_TRAINING = {"shape_steps": 30, "pairs": 2, "side_px": 96, "label_copies": 2}
"""Settings of ``--quick``: every stage runs, none long enough to learn much."""
_FROM_SETTINGS = "that of the settings"
_TLS = "TLS"
_NEEDED = "give --ca, --certificate, --key and --robot-key, or --insecure in a network that nobody else can reach"
_ROBOT_NEEDS = "give --ca and --robot-key, or --insecure in a network that nobody else can reach"
_TOO_MUCH = "--insecure, but certificates or keys are given; leave out one or the other"

SettingsFile = Annotated[
    Path | None, typer.Option("--config", help="YAML file of federated settings; see docs/howto/federated.md.")
]
Public = Annotated[
    list[Path] | None,
    typer.Option(help="Folder of public images, on which the server evaluates detectors. Can be repeated."),
]
Strategy = Annotated[
    str | None,
    typer.Option(
        help="Aggregation: fedavg, fedprox, fedadam, fedmedian, fedtrimmedavg or krum.", show_default=_FROM_SETTINGS
    ),
]
Rounds = Annotated[
    int | None,
    typer.Option(
        min=1, help="Number of rounds. More rounds than before continue a finished run.", show_default=_FROM_SETTINGS
    ),
]
LocalSteps = Annotated[
    int | None,
    typer.Option(min=1, help="Optimiser steps of each robot in each round.", show_default=_FROM_SETTINGS),
]
ServerAddress = Annotated[str, typer.Argument(metavar="HOST:PORT", help="Address of the server.")]
Ca = Annotated[
    Path | None,
    typer.Option(help="Certificate of the authority that signed the server's.", rich_help_panel=_TLS),
]
Certificate = Annotated[Path | None, typer.Option(help="Certificate of this machine.", rich_help_panel=_TLS)]
Key = Annotated[Path | None, typer.Option(help="Private key of --certificate.", rich_help_panel=_TLS)]
Insecure = Annotated[
    bool, typer.Option("--insecure", help="Use neither encryption nor authentication.", rich_help_panel=_TLS)
]


def federated_settings(
    file: Path | None, quick: bool, strategy: str | None, rounds: int | None, local_steps: int | None, seed: int | None
) -> "FederatedSettings":
    """The settings in ``file``, or the default ones, with the changes of the command line.

    Raises:
        ConfigError: the file cannot be read, or a value is invalid.
    """
    from fcslam.config import load, parse
    from fcslam.federated.settings import FederatedSettings

    content = (FederatedSettings() if file is None else load(FederatedSettings, file)).model_dump()
    if quick:
        content |= QUICK
        content["training"] |= QUICK_TRAINING
    if seed is not None:
        content["training"]["seed"] = seed
    given = {"strategy": strategy, "rounds": rounds, "local_steps": local_steps}
    content |= {name: value for name, value in given.items() if value is not None}
    return parse(FederatedSettings, content, "the command line")


@dataclass(frozen=True, slots=True)
class Security:
    """The files and the flag that the command line gives the server for TLS and authentication."""

    ca: Path | None
    certificate: Path | None
    key: Path | None
    robot_keys: tuple[Path, ...]
    insecure: bool

    def certificates(self) -> "Certificates | None":
        """The certificates; None with ``--insecure``.

        Raises:
            TrainingError: something is missing, or is not a file.
        """
        from fcslam.errors import TrainingError
        from fcslam.federated.tls import Certificates

        files = [file for file in (self.ca, self.certificate, self.key, *self.robot_keys) if file is not None]
        for file in files:
            if not file.is_file():
                raise TrainingError(f"{file}: is not a file; {_NEEDED}")
        if self.insecure:
            if files:
                raise TrainingError(_TOO_MUCH)
            return None
        if self.ca is None or self.certificate is None or self.key is None or not self.robot_keys:
            raise TrainingError(_NEEDED)
        return Certificates(self.ca, self.certificate, self.key)


def check_robot_security(ca: Path | None, robot_key: Path | None, insecure: bool) -> None:
    """Check that a robot has an authority and a private key, or that the user wants neither.

    Raises:
        TrainingError: something is missing, is not a file, or is too much.
    """
    from fcslam.errors import TrainingError

    files = [file for file in (ca, robot_key) if file is not None]
    for file in files:
        if not file.is_file():
            raise TrainingError(f"{file}: is not a file; {_ROBOT_NEEDS}")
    if insecure and files:
        raise TrainingError(_TOO_MUCH)
    if not insecure and len(files) < 2:
        raise TrainingError(_ROBOT_NEEDS)


def parse_address(text: str) -> "Address":
    """The address that ``HOST:PORT`` or a URL with both means; brackets around an IPv6 address are removed.

    Raises:
        TrainingError: it is none.
    """
    from fcslam.errors import TrainingError
    from fcslam.federated.tls import Address

    host, colon, port = text.removeprefix("https://").removeprefix("http://").rpartition(":")
    if not (colon and host.strip("[]") and port.isdecimal() and 0 < int(port) < 65536):
        raise TrainingError(f"{text}: is not a HOST:PORT")
    return Address(host.strip("[]"), int(port))
