"""Options of a federated run."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from fcslam.cli.mission_options import chosen_settings

if TYPE_CHECKING:
    from fcslam.learning.federated.settings import FederatedSettings

QUICK: dict[str, object] = {"rounds": 3, "local_steps": 6, "judge_every": 1}
QUICK_TRAINING = {"shape_steps": 30, "pairs": 2, "side_px": 96, "label_copies": 2}
"""Settings of ``--quick``: every stage runs, none long enough to learn much."""


Public = Annotated[
    list[Path] | None,
    typer.Option(help="Folder of public images, on which the server evaluates detectors. Can be repeated."),
]


def round_settings(chosen: list[str] | None, quick: bool) -> "FederatedSettings":
    """The settings that the command line chooses.

    Raises:
        ConfigError: a file cannot be read, or a value is invalid.
    """
    from fcslam.config import changed
    from fcslam.learning.federated.settings import FederatedSettings

    base = FederatedSettings()
    if quick:
        base = changed(base, QUICK | {"training": QUICK_TRAINING}, "--quick")
    return chosen_settings(base, chosen)


def parse_address(text: str) -> tuple[str, int]:
    """Host and port of ``HOST:PORT``; brackets around an IPv6 address are removed.

    Raises:
        TrainingError: the text is not of this form.
    """
    from fcslam.errors import TrainingError

    host, colon, port = text.rpartition(":")
    if not (colon and host.strip("[]") and port.isdecimal() and 0 < int(port) < 65536):
        raise TrainingError(f"{text}: is not a HOST:PORT")
    return host.strip("[]"), int(port)
