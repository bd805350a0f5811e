"""What the arguments and options of commands name: recordings, live robots, poses."""

import math
import os
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from fcslam.cli.output import print_line
from fcslam.cli.warm_up import compiled
from fcslam.errors import InputError

if TYPE_CHECKING:
    from rich.console import Console

    from fcslam.cli.addresses import RosAddress
    from fcslam.lidar.frontend import LidarConfig
    from fcslam.ros.parameters import NodeParameters
    from fcslam.sources import BagOptions, Source, Survey
    from fcslam.sources.faults import Faults

SENSOR_KEYS = ("scan-topic", "odom-topic", "camera-topic", "odom-frame", "base-frame", "laser-pose", "cloud-band")
"""Keys of ``--sensors``; ``scan-topic`` and ``laser-pose`` may be given for each of several lasers."""


def bag_options(given: list[str] | None) -> "BagOptions | None":
    """The values of ``--sensors`` as the readers of bags take them; None if none is given."""
    from fcslam.sources import BagOptions
    from fcslam.sources.point_clouds import CloudBand

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
    poses: list[Any] = []
    for text in values.get("laser-pose", ()):
        upright = text.removesuffix(",upside-down")
        poses.append((*pose("--sensors laser-pose", upright), *[True] * (upright != text)))
    band = CloudBand()
    if "cloud-band" in last:
        of_band = numbers(last["cloud-band"], 2, 3)
        band = CloudBand(*of_band) if of_band else band
        if not of_band or band.low_m >= band.high_m or band.body_radius_m < 0.0:
            raise InputError(
                f"--sensors cloud-band={last['cloud-band']}: is not a band of heights; give metres, as in "
                "cloud-band=0.1,0.6"
            )
    return BagOptions(
        tuple(values.get("scan-topic", ())),
        last.get("odom-topic"),
        last.get("camera-topic"),
        tuple(poses),
        last.get("odom-frame"),
        last.get("base-frame"),
        cloud_band=band,
    )


def open_recording(
    argument: str,
    sensors: list[str] | None,
    console: "Console",
    in_3d: bool = False,
    lidar: "LidarConfig | None" = None,
) -> "tuple[Source, Survey]":
    """Open the recording of an argument ``LOG`` or ``NAME=LOG``, and print what was chosen in it.

    With ``lidar``, a bag is calibrated, as before it is mapped.
    """
    from fcslam.sources import BagOptions, open_source, whole_clouds

    path, name = named_path(argument)
    options = bag_options(sensors)
    options = replace(options or BagOptions(), in_3d=True) if in_3d else options
    source = whole_clouds(open_source(path, options, name), options)
    if lidar is not None:
        from fcslam.robot.calibrating import calibrated

        with compiled(console, in_3d):
            source = calibrated(source, lidar)
    survey = source.survey()
    print_notes(console, survey.notes)
    return source, survey


def named_path(argument: str) -> tuple[Path, str | None]:
    """Path and name in ``LOG`` or ``NAME=LOG``; an existing file is never read as ``NAME=LOG``.

    A path that is not there is refused here, before code is loaded and compiled to read it.
    """
    name, equals, path = argument.partition("=")
    if is_live(argument):
        raise InputError(f"{argument}: is a live robot, not a recording; `fcslam robot {argument}` maps it")
    # Path.exists raises for a name that is too long, and in a folder that cannot be searched.
    if not equals or not name or os.path.exists(argument):
        name, path = "", argument
    # Several files of a bag are joined by commas, and a robot of it follows a colon.
    files = [path] if os.path.exists(path) else (path.rpartition(":")[0] or path).split(",")
    for file in files:
        with suppress(PermissionError):
            try:
                os.stat(file)
            except (FileNotFoundError, NotADirectoryError):
                raise InputError(f"{file}: no such file; check the path of the recording") from None
            except OSError as error:
                raise InputError(f"{file}: cannot be read ({error}); check the path of the recording") from error
    from fcslam.runs.folder import MISSION

    if os.path.exists(os.path.join(path, MISSION)) or os.path.basename(path) == MISSION:
        run = path.removesuffix(MISSION).rstrip(os.sep) or "."
        raise InputError(f"{path}: is a run, not a recording; `fcslam map --onto {run}` continues it")
    return Path(path), name or None


class LiveSource(NamedTuple):
    """Where a live robot is, and how it is read."""

    name: str
    address: "RosAddress"
    options: "BagOptions"
    parameters: "NodeParameters"


def is_live(source: str) -> bool:
    """Whether ADDRESS or NAME=ADDRESS is the address of a live robot."""
    from fcslam.cli.addresses import is_address

    return is_address(source.rpartition("=")[2])


def live_source(
    argument: str, sensors: list[str] | None, ros_parameters: Path | None = None, use_sim_time: bool = False
) -> LiveSource:
    """The live robot of an argument ``ADDRESS`` or ``NAME=ADDRESS``, and its options."""
    from fcslam.cli.addresses import parse_address
    from fcslam.ros.parameters import load_parameters
    from fcslam.sources import BagOptions

    name, _, text = argument.rpartition("=")
    address, parameters = parse_address(text), load_parameters(ros_parameters)
    if use_sim_time:
        parameters = parameters.model_copy(update={"use_sim_time": True})
    return LiveSource(name or address.robot, address, bag_options(sensors) or BagOptions(), parameters)


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
    """The pose that an option gives as X,Y,THETA, metres and radians."""
    given = numbers(text, 3)
    if not given:
        raise InputError(f"{option} {text!r} is not a pose; give X,Y,THETA in metres and radians, as in 0.12,0,3.14")
    x, y, theta = given
    return x, y, theta


def numbers(text: str, *counts: int) -> list[float]:
    """The finite numbers in a text, separated by commas; none if it holds another count or something else."""
    try:
        found = [float(part) for part in text.split(",")]
    except ValueError:
        return []
    return found if len(found) in counts and all(map(math.isfinite, found)) else []
