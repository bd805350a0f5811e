"""What commands share that read recordings: arguments, options, and what is said about a recording."""

import math
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from fcslam.errors import InputError

if TYPE_CHECKING:
    from rich.console import Console

    from fcslam.sources import BagOptions, Source

_BAGS = "ROS bags"

ScanTopic = Annotated[
    str | None,
    typer.Option("--scan-topic", metavar="TOPIC", help="The laser scans to read.", rich_help_panel=_BAGS),
]
OdomTopic = Annotated[
    str | None,
    typer.Option("--odom-topic", metavar="TOPIC", help="The odometry to read, or tf with it.", rich_help_panel=_BAGS),
]
CameraTopic = Annotated[
    str | None,
    typer.Option("--camera-topic", metavar="TOPIC", help="The images to read.", rich_help_panel=_BAGS),
]
LaserPose = Annotated[
    str | None,
    typer.Option(
        "--laser-pose",
        metavar="X,Y,THETA",
        help="Where the laser sits in base (metres, radians), in place of what tf says.",
        rich_help_panel=_BAGS,
    ),
]


def bag_options(
    scan_topic: str | None, odom_topic: str | None, camera_topic: str | None, laser_pose: str | None
) -> "BagOptions | None":
    """The options of bags; None if none is given.

    Raises:
        InputError: ``laser_pose`` is no pose.
    """
    from fcslam.sources import BagOptions

    if scan_topic is None and odom_topic is None and camera_topic is None and laser_pose is None:
        return None
    return BagOptions(scan_topic, odom_topic, camera_topic, None if laser_pose is None else _pose(laser_pose))


def open_recording(argument: str, options: "BagOptions | None") -> "Source":
    """The recording that ``LOG`` or ``NAME=LOG`` means; a file that is there is never taken for a name.

    Raises:
        SourceError: it is no recording.
    """
    from fcslam.sources import open_source

    name, equals, path = argument.partition("=")
    if not equals or not name or Path(argument).exists():
        return open_source(Path(argument), options)
    return open_source(Path(path), options, name)


def show_notes(console: "Console", notes: Iterable[str]) -> None:
    """Say what was chosen where recordings leave a choice, each thing once."""
    for note in dict.fromkeys(notes):
        console.print(note, highlight=False, markup=False, soft_wrap=True)


def show_faults(console: "Console", sources: "Iterable[Source]") -> None:
    """Say what was wrong with recordings that could be read all the same."""
    for source in sources:
        if source.faults:
            console.print(f"{source.name}: {source.faults}", highlight=False, markup=False, soft_wrap=True)


def _pose(text: str) -> tuple[float, float, float]:
    try:
        x, y, theta = map(float, text.split(","))
    except ValueError:
        x = y = theta = math.nan
    if not all(map(math.isfinite, (x, y, theta))):
        raise InputError(f"--laser-pose {text!r} is no pose; give metres and radians, as in --laser-pose 0.12,0,3.14")
    return x, y, theta
