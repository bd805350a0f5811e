"""`fcslam config`: the configuration as a file."""

import typer

app = typer.Typer(no_args_is_help=True, help="The configuration of a run.")


@app.command(epilog="Example: fcslam config dump > mission.yaml")
def dump() -> None:
    """Print the complete default configuration as YAML, each key under a comment that explains it."""
    from fcslam import config
    from fcslam.mission import MissionConfig

    typer.echo(config.dump(MissionConfig()), nl=False)
