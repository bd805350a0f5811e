"""Options of a federated run, of which each subcommand uses those that it needs."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from fcslam.learning.federated.settings import FederatedSettings

QUICK = {"rounds": 3, "local_steps": 6, "judge_every": 1}
QUICK_TRAINING = {"shape_steps": 30, "pairs": 2, "side_px": 96, "label_copies": 2}
"""Settings of ``--quick``: every stage runs, none long enough to learn much."""
_FROM_SETTINGS = "that of the settings"

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


def federated_settings(
    file: Path | None, quick: bool, strategy: str | None, rounds: int | None, local_steps: int | None, seed: int | None
) -> "FederatedSettings":
    """The settings in ``file``, or the default ones, with the changes of the command line.

    Raises:
        ConfigError: the file cannot be read, or a value is invalid.
    """
    from fcslam.config import load, parse
    from fcslam.learning.federated.settings import FederatedSettings

    content = (FederatedSettings() if file is None else load(FederatedSettings, file)).model_dump()
    if quick:
        content |= QUICK
        content["training"] |= QUICK_TRAINING
    if seed is not None:
        content["training"]["seed"] = seed
    given = {"strategy": strategy, "rounds": rounds, "local_steps": local_steps}
    content |= {name: value for name, value in given.items() if value is not None}
    return parse(FederatedSettings, content, "the command line")


def parse_address(text: str) -> tuple[str, int]:
    """Host and port of ``HOST:PORT``; brackets around an IPv6 address are removed.

    Raises:
        TrainingError: it is none.
    """
    from fcslam.errors import TrainingError

    host, colon, port = text.rpartition(":")
    if not (colon and host.strip("[]") and port.isdecimal() and 0 < int(port) < 65536):
        raise TrainingError(f"{text}: is not a HOST:PORT")
    return host.strip("[]"), int(port)
