"""`fcslam tools config`: the configuration as a file."""

from typing import Annotated

import typer

from fcslam.cli.options import mission_config
from fcslam.lab.presets import Preset


def config(
    preset: Annotated[Preset | None, typer.Argument(help="A preset in place of the defaults.")] = None,
) -> None:
    """Print a complete configuration of a mission as YAML. A comment above each key explains it."""
    from fcslam.config import dump

    typer.echo(dump(mission_config(None if preset is None else [preset])), nl=False)
