"""Commands that read recordings: the options of ROS bags, opening, and notices about a recording."""

import math
import os
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
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


@dataclass(frozen=True)
class TopicFlags:
    """The topics of a robot."""

    scan_topic: Annotated[
        list[str] | None,
        typer.Option(
            metavar="TOPIC", rich_help_panel=_BAGS,
            help="Topic of the laser scans; repeat it if the robot has several lasers.",
        ),
    ] = None  # fmt: skip
    odom_topic: Annotated[
        str | None,
        typer.Option(
            metavar="TOPIC", rich_help_panel=_BAGS,
            help="Topic of the odometry; /tf reads it from tf, none maps without it.",
        ),
    ] = None  # fmt: skip
    camera_topic: Annotated[
        str | None, typer.Option(metavar="TOPIC", help="Topic of the camera images.", rich_help_panel=_BAGS)
    ] = None

    def options(self) -> "BagOptions | None":
        """As the readers of bags take them; None if none is given."""
        from fcslam.sources import BagOptions

        options = BagOptions(tuple(self.scan_topic or ()), self.odom_topic, self.camera_topic)
        return None if options == BagOptions() else options


@dataclass(frozen=True)
class BagFlags(TopicFlags):
    """The topics, frames and mounting of the sensors of a robot."""

    odom_frame: Annotated[
        str | None,
        typer.Option(
            metavar="FRAME", rich_help_panel=_BAGS,
            help="Read the odometry from tf, where its parent frame has this name.",
        ),
    ] = None  # fmt: skip
    base_frame: Annotated[
        str | None,
        typer.Option(metavar="FRAME", rich_help_panel=_BAGS, help="Frame of the robot whose pose the odometry is."),
    ] = None
    laser_pose: Annotated[
        list[str] | None,
        typer.Option(
            metavar="X,Y,THETA[,upside-down]", rich_help_panel=_BAGS,
            help="Pose of the laser in the base frame (metres, radians). It replaces the transform in tf. Give one for "
            "each --scan-topic, in the same order.",
        ),
    ] = None  # fmt: skip
    cloud_band: Annotated[
        str | None,
        typer.Option(
            metavar="LOW,HIGH[,BODY]", rich_help_panel=_BAGS,
            help="Heights above the floor (metres) of the points of a 3D LiDAR or depth camera that count; 0.1,0.6 if "
            "not given. Points within BODY metres (0.4) of the base are of the robot.",
        ),
    ] = None  # fmt: skip

    def options(self) -> "BagOptions | None":
        """As the readers of bags take them; None if none is given.

        Raises:
            InputError: a laser pose is not a pose, or the band is not a band.
        """
        from fcslam.sources import BagOptions

        options = replace(
            super().options() or BagOptions(),
            laser_poses=tuple(map(_laser_pose, self.laser_pose or ())),
            odom_frame=self.odom_frame,
            base_frame=self.base_frame,
            cloud_band=_cloud_band(self.cloud_band),
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
