"""`fcslam config`: the configuration as a file."""

import typer

from fcslam.cli.examples import examples

_DUMP = "fcslam config dump > mission.yaml"

app = typer.Typer(no_args_is_help=True)


@app.callback(epilog=examples(_DUMP))
def config() -> None:
    """Print the configuration of a mission."""


@app.command(epilog=examples(_DUMP, "fcslam map robot1.bag robot2.bag --config mission.yaml"))
def dump() -> None:
    """Print the complete default configuration as YAML. A comment above each key explains it."""
    from fcslam.config import dump as as_yaml
    from fcslam.mission import MissionConfig

    typer.echo(as_yaml(MissionConfig()), nl=False)
