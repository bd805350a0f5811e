"""The command line: one module a command. What a command needs is imported when it runs, so that help is quick."""

from collections.abc import Sequence
from typing import Annotated

import click
import typer

import fcslam
from fcslam.cli import certificates, config, demo, evaluate, extract, federate, serve, simulate, train
from fcslam.cli import convert as conversion
from fcslam.cli import map as mapping
from fcslam.cli import robot as robots
from fcslam.errors import FcslamError

BAD_INPUT, INTERRUPTED = 2, 130
"""Exit codes: 2 for what the user can mend, 130 as a shell says it for Ctrl-C."""

app = typer.Typer(
    name="fcslam",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)
app.command("map", epilog="Example: fcslam map robot1.clf.gz robot2.clf.gz --output runs/building")(
    mapping.map_recordings
)
app.command(
    "convert",
    epilog="Example: fcslam convert robot1.clf.gz robot1.bag, fcslam convert robot2.mcap robot2.clf.gz "
    "--scan-topic /front/scan",
)(conversion.convert)
app.command(
    "simulate",
    epilog="Example: fcslam simulate --output office --building office --no-camera, "
    "fcslam simulate --output day-and-evening --robots 2 --lighting day --lighting evening --moved-furniture 0.3, "
    "and after an interruption the same with --resume",
)(simulate.simulate)
app.command("extract", epilog="Example: fcslam extract photos --output features --keypoints 1000")(extract.extract)
app.command("demo", epilog="Example: fcslam demo --output demo --robots 4")(demo.demo)
app.command("train", epilog="Example: fcslam train photos --output detector, fcslam train photos -o try --quick")(
    train.train
)
app.command(
    "federate",
    epilog="Example: fcslam federate --local robot1 robot2 robot3 --output fleet --public photos, "
    "fcslam federate --local robot1 robot2 --output try --quick",
)(federate.federate)
app.command(
    "robot",
    epilog="Example: fcslam robot robot1.clf.gz --server https://cloud.example:8443 --state state/robot1 "
    "--token-file robot1.token, fcslam robot --explain-traffic",
)(robots.robot)
app.command(
    "serve",
    epilog="Example: fcslam serve --data missions, fcslam serve --data missions --host 0.0.0.0 --tokens tokens.yaml "
    "--tls-certificate cloud.pem --tls-key cloud.key",
)(serve.serve)
app.command(
    "certificates",
    epilog="Example: fcslam certificates --output credentials --host cloud.local --robot robot1 --robot robot2 "
    "--viewer lab --admin boss",
)(certificates.certificates)
app.add_typer(config.app, name="config")
app.add_typer(evaluate.app, name="evaluate")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command that ``arguments`` (or the process's own) name, and return its exit code.

    What the user can mend is one line on stderr, never a traceback.
    """
    try:
        code = app(arguments, standalone_mode=False) or 0
    except FcslamError as error:
        return _fail(str(error), BAD_INPUT)
    except click.ClickException as error:
        error.show()
        return error.exit_code
    except (click.Abort, KeyboardInterrupt):
        code = INTERRUPTED
    # typer itself turns Ctrl-C into this code
    return _fail("interrupted", code) if code == INTERRUPTED else int(code)


def _fail(message: str, code: int) -> int:
    typer.echo(f"fcslam: {' '.join(message.split())}", err=True)
    return code


def _print_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"fcslam {fcslam.__version__}")
        raise typer.Exit


@app.callback()
def _fcslam(
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version and exit.")
    ] = False,
) -> None:
    """Several robots map one building together: one map, every robot's trajectory in it."""
