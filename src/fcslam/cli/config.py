"""`fcslam config`: the configuration as a file."""

import typer

from fcslam.cli.examples import examples
from fcslam.cli.mission_options import PresetName, mission_config

_DUMP = "fcslam config dump > mission.yaml"

app = typer.Typer(no_args_is_help=True)


@app.callback(epilog=examples(_DUMP))
def config() -> None:
    """Print the configuration of a mission."""


@app.command(
    epilog=examples(
        _DUMP,
        "fcslam map robot1.bag robot2.bag --config mission.yaml",
        "fcslam config dump --preset paper > paper.yaml",
    )
)
def dump(preset: PresetName = None) -> None:
    """Print a complete configuration as YAML, the default one or a preset. A comment above each key explains it."""
    from fcslam.config import dump as as_yaml

    typer.echo(as_yaml(mission_config(None, preset=preset)), nl=False)
