"""The command line: a module for each command, and one for small ones. Commands import what they need when they run."""

import errno
import io
import math
import os
import sys
from collections.abc import Callable, Sequence
from typing import Annotated

import click
import typer

import fcslam
from fcslam.cli import (
    demo,
    edit,
    evaluate,
    federate,
    info,
    record,
    serve,
    show,
    simulate,
    tool_commands,
    train,
)
from fcslam.cli import localize as localization
from fcslam.cli import map as mapping
from fcslam.cli import play as playback
from fcslam.cli import robot as robots
from fcslam.cli import warm_up as warming
from fcslam.errors import FcslamError, InputError, printable

BAD_INPUT, INTERRUPTED, READER_GONE = 2, 130, 1
"""Exit codes: 2 for errors that the user can correct, 130 for Ctrl-C as in shells, 1 for a closed pipe as in click."""
EXTRAS = {
    **dict.fromkeys(
        ("cryptography", "fastapi", "httpx", "prometheus_client", "starlette", "uvicorn"), "fcslam[service]"
    ),
    "matplotlib": "fcslam[plots]",
}
"""By package, the extra that installs it; mapping recordings needs none of them."""
PROGRAM = "fcslam"
MAPS, ROBOTS, STUDY = "Maps", "Robots and service", "Measurements and tools"
RECORDINGS, LEARNING, SETUP = "Simulation and comparison", "Learning", "Setup"
"""Groups of the commands in `fcslam --help` and `fcslam tools --help`."""
COMPLETION_VARIABLE = "_FCSLAM_COMPLETE"
"""Environment variable by which a shell asks for completions instead of running the command."""


app = typer.Typer(
    name=PROGRAM,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)
tools = typer.Typer(
    no_args_is_help=True,
    help="Simulate recordings, compare dates, train the cameras' detector, and set up a fleet.",
)
COMMANDS: dict[str, tuple[str, Callable[..., None] | typer.Typer]] = {
    "map": (MAPS, mapping.map_recordings),
    "info": (MAPS, info.info),
    "show": (MAPS, show.show),
    "edit": (MAPS, edit.app),
    "robot": (ROBOTS, robots.robot),
    "play": (ROBOTS, playback.play),
    "localize": (ROBOTS, localization.localize),
    "record": (ROBOTS, record.record),
    "serve": (ROBOTS, serve.serve),
    "demo": (STUDY, demo.demo),
    "evaluate": (STUDY, evaluate.app),
    "tools": (STUDY, tools),
    "tools simulate": (RECORDINGS, simulate.simulate),
    "tools changes": (RECORDINGS, tool_commands.changes),
    "tools config": (SETUP, tool_commands.config),
    "tools certificates": (SETUP, tool_commands.certificates),
    "tools warm-up": (SETUP, warming.warm_up),
    "tools train": (LEARNING, train.train),
    "tools federate": (LEARNING, federate.federate),
    "tools extract": (LEARNING, tool_commands.extract),
}
"""Group in the help, and function, of each command. A typer has commands and examples of its own."""
EXAMPLES = """\
fcslam map robot1.clf.gz robot2.clf.gz
fcslam map anna=run1.bag ben=run2.mcap -o runs/building
fcslam map --onto runs/building -o runs/building-edited
fcslam info robot1.mcap --json
fcslam show runs/building
fcslam robot ros2:/robot1 -o runs/robot1
fcslam robot ros2:/robot1 --server https://hub --state s --credentials c
fcslam play robot1.clf.gz --server http://127.0.0.1:8340 --state state
fcslam play robot1.bag --server https://cloud:8340 --state s --credentials c
fcslam localize ros2:/robot1 --map office.yaml --initial-pose 2,3.5,1.57
fcslam localize ros2:/robot1 --server http://127.0.0.1:8340 --map copy
fcslam edit list runs/building
fcslam edit undo runs/building 2
fcslam edit veto runs/building anna 1000.0 ben 1000.001
fcslam edit pin runs/building anna 1000.0 ben 1000.001
fcslam edit close runs/building anna 1000.0 ben 1000.001 --pose 0.5,0,3.1
fcslam edit remove runs/building ben --from 1010 --to 1025
fcslam edit floor runs/building anna+1 2
fcslam edit erase runs/building "1,2 3,2 3,4 1,4"
fcslam edit free runs/building "1,2 3,4"
fcslam edit keep-out runs/building "1,2 3,4"
fcslam edit area runs/building "Room 12" "1,2 3,4"
fcslam edit place runs/building --to-walls
fcslam edit place runs/building --at anna,1000.5=3,4,1.57
fcslam edit place runs/building --match 1.5,2=0,0 --match 9,2.5=7.5,0
fcslam record ros2:/robot1 -o day.mcap
fcslam record robot1.clf.gz -o robot1.bag
fcslam serve --data cloud --host 0.0.0.0 --credentials credentials
fcslam demo --robots 4 --no-camera -o demo4
fcslam evaluate fleet fleet/run --truth fleet
fcslam evaluate relations runs/intel intel.relations.gz
fcslam evaluate quality fleet/run
fcslam tools simulate --building office --no-camera
fcslam tools simulate --lighting day --lighting evening -c moved_furniture=0.3
fcslam tools changes runs/building --since 2026-11-20 -o changes/week
fcslam tools config paper > paper.yaml
fcslam tools certificates --host cloud.local --robot robot1 --admin boss
fcslam tools warm-up
fcslam tools train photos -o detector
fcslam tools federate robot1 robot2 robot3 --public photos -o fleet
fcslam tools extract photos -o features --keypoints 1000
"""
"""Examples for the help of each command: the lines that begin with it."""


def _examples(path: str) -> str:
    """The epilog of a command's help, to be copied as it stands; typer removes single line breaks."""
    lines = (line for line in EXAMPLES.splitlines() if f"{line} ".startswith(f"fcslam {path} "))
    return "\n\n".join(("Examples:", *lines))


for _path, (_panel, _command) in COMMANDS.items():
    _group, _name = (tools if _path.startswith("tools ") else app), _path.removeprefix("tools ")
    if isinstance(_command, typer.Typer):
        for _one in _command.registered_commands:
            assert _one.callback is not None
            _one.epilog = _examples(f"{_path} {_one.name or _one.callback.__name__}")
        _group.add_typer(_command, name=_name, rich_help_panel=_panel, epilog=_examples(_path))
    else:
        _group.command(_name, rich_help_panel=_panel, epilog=_examples(_path))(_command)


def _finite(text: str) -> float:
    """Number of an option; click takes `nan` for one in every range."""
    number = float(text)
    if not math.isfinite(number):
        raise InputError(f"{text}: is not a finite number; give one to the option")
    return number


click.types.FloatParamType._number_class = staticmethod(_finite)  # type: ignore[assignment]


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command that ``arguments`` (or the process's own) name, and return its exit code.

    An error that the user can correct is one line on stderr, never a traceback.
    """
    if COMPLETION_VARIABLE in os.environ:
        # A path completes to nothing, so that shells complete files. Typer would end the completion.
        click.Path.shell_complete = lambda *_: []  # type: ignore[method-assign]
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")  # a terminal may lack a letter of a robot's name
    try:
        code = app(arguments, prog_name=PROGRAM, standalone_mode=False) or 0
        sys.stdout.flush()
    except FcslamError as error:
        return _fail(str(error), BAD_INPUT)
    except ModuleNotFoundError as error:
        extra = EXTRAS.get((error.name or "").partition(".")[0])
        if extra is None:
            raise
        return _fail(f"this needs {error.name}; install it: pip install '{extra}'", BAD_INPUT)
    except OSError as error:
        if error.errno not in (errno.EPIPE, errno.ENOSPC) or error.filename is not None:
            raise
        # What is left goes nowhere: Python writes it at its end, and would complain.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        if error.errno == errno.EPIPE:
            return READER_GONE
        return _fail(f"standard output cannot be written ({error.strerror}); make room", BAD_INPUT)
    except click.ClickException as error:
        return _show(error)
    except (click.Abort, KeyboardInterrupt):
        code = INTERRUPTED
    # typer itself turns Ctrl-C into this code
    return _fail("interrupted", code) if code == INTERRUPTED else int(code)


def _show(error: click.ClickException) -> int:
    if isinstance(error, click.exceptions.NoArgsIsHelpError) or not isinstance(error, click.UsageError):
        error.show()
        return error.exit_code
    how = f" (`{error.ctx.command_path} -h` shows what there is)" if error.ctx else ""
    return _fail(f"{error.format_message().rstrip('.')}{how}", error.exit_code)


def _fail(message: str, code: int) -> int:
    typer.echo(f"fcslam: {printable(' '.join(message.split()))}", err=True)
    return code


def _print_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"fcslam {fcslam.__version__}")
        raise typer.Exit


@app.callback(epilog="Examples:\n\nfcslam demo\n\nfcslam map robot1.bag robot2.bag\n\nfcslam map --help")
def _fcslam(
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version and exit.")
    ] = False,
) -> None:
    """Multi-robot LiDAR SLAM: map the recordings of several robots together."""
