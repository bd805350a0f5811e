"""Options that several commands share, each declared once."""

from pathlib import Path
from typing import Annotated, Any

import typer

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

_WORKERS = "Workers"
WorkersOption = Annotated[
    str,
    typer.Option(
        "--workers",
        metavar="N|ADDRESS",
        help="Processes that verify closures, this one included, or the Dask scheduler of a cluster: "
        "tls://HOST:PORT or tcp://HOST:PORT, with the certificates of Dask's configuration. The result is the same.",
        rich_help_panel=_WORKERS,
    ),
]


def output_option(description: str, parent: str) -> Any:
    """The option ``--output``, whose default is a new folder ``parent/<time>``; see ``output.new_folder``."""
    return typer.Option("--output", "-o", help=description, show_default=f"{parent}/<time>")
