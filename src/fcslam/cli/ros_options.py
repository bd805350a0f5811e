"""Options of commands that read a live robot from a ROS network."""

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from fcslam.ros.parameters import NodeParameters

_ROS = "ROS networks"


RosParameters = Annotated[
    Path | None,
    typer.Option(
        metavar="FILE",
        rich_help_panel=_ROS,
        help="Parameters (YAML) of a ROS 2 node, with the names of slam_toolbox where they mean the same.",
    ),
]
UseSimTime = Annotated[
    bool, typer.Option("--use-sim-time", help="Take the time from /clock, as with a simulator.", rich_help_panel=_ROS)
]


def node_parameters(file: Path | None, use_sim_time: bool) -> "NodeParameters":
    """The parameters in the file, or the default ones, with the changes of the command line.

    Raises:
        ConfigError: the file cannot be read, or a parameter is unknown or out of range.
    """
    from fcslam.ros.parameters import load_parameters

    parameters = load_parameters(file)
    return parameters.model_copy(update={"use_sim_time": True}) if use_sim_time else parameters


@contextmanager
def stopping(stop: Callable[[], None]) -> Iterator[None]:
    """Call ``stop`` at Ctrl-C and SIGTERM, so that what was mapped or recorded is kept; a second Ctrl-C interrupts."""
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    stopped = threading.Event()

    def end(*_: object) -> None:
        if stopped.is_set():
            raise KeyboardInterrupt
        stopped.set()
        stop()

    for number in before:
        signal.signal(number, end)
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
