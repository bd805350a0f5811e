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

SENSOR_KEYS = ("scan-topic", "odom-topic", "camera-topic", "odom-frame", "base-frame", "laser-pose", "cloud-band")
"""Keys of ``--sensors``; ``scan-topic`` and ``laser-pose`` may be given for each of several lasers."""

Sensors = Annotated[
    list[str] | None,
    typer.Option(
        metavar="KEY=VALUE",
        help="ROS topics and frames to read instead of those that fcslam chooses; repeat it for each key. scan-topic "
        "(one for "
        "each laser), odom-topic (/tf: from tf; none), camera-topic; odom-frame and base-frame of the odometry in tf; "
        "laser-pose=X,Y,THETA[,upside-down] in the base frame (one for each scan-topic); cloud-band=LOW,HIGH[,BODY], "
        "the heights of a 3D LiDAR or depth camera that count, and the radius of the robot. Metres, radians.",
    ),
]


def bag_options(given: list[str] | None) -> "BagOptions | None":
    """The values of ``--sensors`` as the readers of bags take them; None if none is given.

    Raises:
        InputError: a key is unknown or there twice, a laser pose is not a pose, or the band is not a band.
    """
    from fcslam.sources import BagOptions

    if not given:
        return None
    values: dict[str, list[str]] = {}
    for text in given:
        key, equals, value = text.partition("=")
        if key not in SENSOR_KEYS or not (equals and value):
            raise InputError(f"--sensors {text}: expected KEY=VALUE with a key of {', '.join(SENSOR_KEYS)}")
        if key in values and key not in ("scan-topic", "laser-pose"):
            raise InputError(f"--sensors {key}: is given twice; give it once")
        values.setdefault(key, []).append(value)
    last = {key: of[-1] for key, of in values.items()}
    return BagOptions(
        tuple(values.get("scan-topic", ())),
        last.get("odom-topic"),
        last.get("camera-topic"),
        tuple(map(_laser_pose, values.get("laser-pose", ()))),
        last.get("odom-frame"),
        last.get("base-frame"),
        cloud_band=_cloud_band(last.get("cloud-band")),
    )


def _laser_pose(text: str) -> "GivenPose":
    upright = text.removesuffix(",upside-down")
    x, y, theta = pose("--sensors laser-pose", upright)
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
        raise InputError(
            f"--sensors cloud-band={text}: is not a band of heights; give metres, as in cloud-band=0.1,0.6"
        )
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
        for warning in found.warnings:
            print_line(console, f"warning: {name}: {warning}")


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
