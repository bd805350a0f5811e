"""Commands that read recordings: the options of ROS bags, opening, and notices about a recording."""

import math
import os
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from fcslam.cli.output import print_line
from fcslam.errors import InputError

if TYPE_CHECKING:
    from rich.console import Console

    from fcslam.sources import BagOptions, Source
    from fcslam.sources.bags.options import GivenPose
    from fcslam.sources.faults import Faults
    from fcslam.sources.point_clouds import CloudBand

_BAGS = "ROS bags"

ScanTopic = Annotated[
    list[str] | None,
    typer.Option(
        "--scan-topic", metavar="TOPIC", rich_help_panel=_BAGS,
        help="Topic of the laser scans; repeat it if the robot has several lasers.",
    ),
]  # fmt: skip
OdomTopic = Annotated[
    str | None,
    typer.Option(
        "--odom-topic",
        metavar="TOPIC",
        help="Topic of the odometry; /tf reads it from tf, none maps without it.",
        rich_help_panel=_BAGS,
    ),
]
OdomFrame = Annotated[
    str | None,
    typer.Option(
        "--odom-frame", metavar="FRAME", rich_help_panel=_BAGS,
        help="Read the odometry from tf, where its parent frame has this name.",
    ),
]  # fmt: skip
BaseFrame = Annotated[
    str | None,
    typer.Option(
        "--base-frame", metavar="FRAME", rich_help_panel=_BAGS,
        help="Frame of the robot whose pose the odometry is.",
    ),
]  # fmt: skip
CameraTopic = Annotated[
    str | None,
    typer.Option("--camera-topic", metavar="TOPIC", help="Topic of the camera images.", rich_help_panel=_BAGS),
]
LaserPose = Annotated[
    list[str] | None,
    typer.Option(
        "--laser-pose",
        metavar="X,Y,THETA[,upside-down]",
        help="Pose of the laser in the base frame (metres, radians). It replaces the transform in tf. Give one for "
        "each --scan-topic, in the same order.",
        rich_help_panel=_BAGS,
    ),
]


CloudHeights = Annotated[
    str | None,
    typer.Option(
        "--cloud-band", metavar="LOW,HIGH[,BODY]", rich_help_panel=_BAGS,
        help="Heights above the floor (metres) of the points of a 3D LiDAR or depth camera that count; 0.1,0.6 if not "
        "given. Points within BODY metres (0.4) of the base are of the robot.",
    ),
]  # fmt: skip
InitialPose = Annotated[
    str | None,
    typer.Option(
        metavar="X,Y,THETA",
        help="About where the robot starts in the map (metres, radians).",
        show_default="anywhere",
    ),
]


def bag_options(
    scan_topics: list[str] | None, odom_topic: str | None, camera_topic: str | None, laser_poses: list[str] | None,
    odom_frame: str | None = None, base_frame: str | None = None,
    cloud_band: str | None = None,
) -> "BagOptions | None":  # fmt: skip
    """The options of bags; None if none is given.

    Raises:
        InputError: one of ``laser_poses`` is not a pose, or ``cloud_band`` is not a band.
    """
    from fcslam.sources import BagOptions

    options = BagOptions(
        tuple(scan_topics or ()),
        odom_topic,
        camera_topic,
        tuple(map(_laser_pose, laser_poses or ())),
        odom_frame,
        base_frame,
        cloud_band=_cloud_band(cloud_band),
    )
    return None if options == BagOptions() else options


def _laser_pose(text: str) -> "GivenPose":
    upright = text.removesuffix(",upside-down")
    x, y, theta = pose("--laser-pose", upright)
    return (x, y, theta) if upright == text else (x, y, theta, True)


def _cloud_band(text: str | None) -> "CloudBand":
    from fcslam.sources.point_clouds import CloudBand

    if text is None:
        return CloudBand()
    try:
        low_m, high_m, *body_m = map(float, text.split(","))
        band = CloudBand(low_m, high_m, *body_m)
    except (TypeError, ValueError):
        band = CloudBand(math.nan)
    if not (band.low_m < band.high_m and 0.0 <= band.body_radius_m < math.inf):  # false for NaN
        raise InputError(f"--cloud-band {text!r} is not a band of heights; give metres, as in --cloud-band 0.1,0.6")
    return band


def open_recording(argument: str, options: "BagOptions | None") -> "Source":
    """Open the recording of an argument ``LOG`` or ``NAME=LOG``; an existing file is never read as ``NAME=LOG``.

    Raises:
        SourceError: it is not a recording.
    """
    from fcslam.sources import open_source

    path, name = _named(argument)
    return open_source(path, options, name)


def open_recordings(arguments: Iterable[str], options: "BagOptions | None") -> "list[Source]":
    """Open the recordings of a fleet, each as ``open_recording`` does, with topics chosen once for all bags.

    Raises:
        SourceError: one is not a recording, or is given twice.
    """
    from fcslam.sources import open_fleet

    return open_fleet(map(_named, arguments), options)


def _named(argument: str) -> tuple[Path, str | None]:
    name, equals, path = argument.partition("=")
    # Path.exists raises for a name that is too long, and in a folder that cannot be searched.
    if not equals or not name or os.path.exists(argument):
        return Path(argument), None
    return Path(path), name


def print_notes(console: "Console", notes: Iterable[str]) -> None:
    """Print which topics and frames were chosen where a recording has several, each note once."""
    for note in dict.fromkeys(notes):
        print_line(console, note)


def print_faults(console: "Console", faults: "Mapping[str, Faults]") -> None:
    """Print the faults that were tolerated in recordings, by their names."""
    for name, found in faults.items():
        if found:
            print_line(console, f"{name}: {found}")


def pose(option: str, text: str) -> tuple[float, float, float]:
    """The pose that an option gives as X,Y,THETA, metres and radians.

    Raises:
        InputError: it is not a pose.
    """
    try:
        x, y, theta = map(float, text.split(","))
    except ValueError:
        x = y = theta = math.nan
    if not all(map(math.isfinite, (x, y, theta))):
        raise InputError(f"{option} {text!r} is not a pose; give X,Y,THETA in metres and radians, as in 0.12,0,3.14")
    return x, y, theta
