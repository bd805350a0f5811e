"""What the commands that measure places ask for alike."""

from pathlib import Path
from typing import Annotated

import typer

Sets = Annotated[
    list[Path],
    typer.Argument(
        metavar="SETS...",
        help="Folders of images with their truth (dataset.csv, loop_pairs.txt, associations.txt or matches.csv), "
        "fleets that fcslam simulate recorded with cameras, or recordings of a LiDAR.",
    ),
]
Features = Annotated[
    str,
    typer.Option(
        help="Of images: orb, onnx (the network that comes with fcslam), an .onnx file, or a folder of extracted "
        "features, <name of the set>/..., as fcslam extract writes them."
    ),
]
TrainOn = Annotated[
    list[Path] | None,
    typer.Option(help="Folder of other images, to train a fixed vocabulary on; may be given several times."),
]
Label = Annotated[list[str] | None, typer.Option(help="Of sets with labels only this one; may be given several times.")]
