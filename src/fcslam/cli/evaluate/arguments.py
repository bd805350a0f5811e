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

Sets = Annotated[
    list[Path],
    typer.Argument(
        metavar="SETS...",
        help="Folders of images with their truth (dataset.csv, loop_pairs.txt, associations.txt or matches.csv), "
        "fleets with cameras that fcslam tools simulate wrote, or recordings of a LiDAR.",
    ),
]
Features = Annotated[
    str,
    typer.Option(
        help="Features of images: orb, onnx (the bundled network), an .onnx file, or a folder that `fcslam tools "
        "extract` wrote, with a subfolder for each set."
    ),
]
TrainOn = Annotated[
    list[Path] | None,
    typer.Option(help="Folder of other images, to train the static vocabulary on. Can be repeated."),
]
Label = Annotated[
    list[str] | None, typer.Option(help="Use only this label of sets with labels. Can be repeated.", show_default="all")
]
