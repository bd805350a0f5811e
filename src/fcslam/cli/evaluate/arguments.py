"""Arguments that several `fcslam evaluate` commands share."""

from pathlib import Path
from typing import Annotated

import typer

RunFolder = Annotated[Path, typer.Argument(help="Run folder to measure.")]
Reference = Annotated[
    Path, typer.Argument(metavar="RELATIONS", help="Relations file, plain or compressed by gzip or xz.")
]
SEED = 1
"""Seed of all random draws, bootstrap included."""
