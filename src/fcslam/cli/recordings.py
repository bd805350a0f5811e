"""Commands that read recordings: the options of ROS bags, opening, and notices about a recording."""

import math
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from fcslam.cli.output import print_line
from fcslam.errors import InputError

if TYPE_CHECKING:
    from rich.console import Console

    from fcslam.sources import BagOptions, Source

_BAGS = "ROS bags"

ScanTopic = Annotated[
    str | None,
    typer.Option("--scan-topic", metavar="TOPIC", help="Topic of the laser scans.", rich_help_panel=_BAGS),
]
OdomTopic = Annotated[
    str | None,
    typer.Option(
        "--odom-topic", metavar="TOPIC", help="Topic of the odometry; /tf reads it from tf.", rich_help_panel=_BAGS
    ),
]
CameraTopic = Annotated[
    str | None,
    typer.Option("--camera-topic", metavar="TOPIC", help="Topic of the camera images.", rich_help_panel=_BAGS),
]
LaserPose = Annotated[
    str | None,
    typer.Option(
        "--laser-pose",
        metavar="X,Y,THETA",
        help="Pose of the laser in the base frame (metres, radians). It replaces the transform in tf.",
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
    """Open the recording of an argument ``LOG`` or ``NAME=LOG``; an existing file is never read as ``NAME=LOG``.

    Raises:
        SourceError: it is no recording.
    """
    from fcslam.sources import open_source

    name, equals, path = argument.partition("=")
    if not equals or not name or Path(argument).exists():
        return open_source(Path(argument), options)
    return open_source(Path(path), options, name)


def print_notes(console: "Console", notes: Iterable[str]) -> None:
    """Print which topics and frames were chosen where a recording has several, each note once."""
    for note in dict.fromkeys(notes):
        print_line(console, note)


def print_faults(console: "Console", sources: "Iterable[Source]") -> None:
    """Print the faults that were tolerated in recordings."""
    for source in sources:
        if source.faults:
            print_line(console, f"{source.name}: {source.faults}")


def _pose(text: str) -> tuple[float, float, float]:
    try:
        x, y, theta = map(float, text.split(","))
    except ValueError:
        x = y = theta = math.nan
    if not all(map(math.isfinite, (x, y, theta))):
        raise InputError(f"--laser-pose {text!r} is no pose; give metres and radians, as in --laser-pose 0.12,0,3.14")
    return x, y, theta
