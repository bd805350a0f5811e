"""The known formats of recordings, and opening a recording by its content."""

import os
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from fcslam.errors import SourceError
from fcslam.sources.bags.container import is_bag, parts_of
from fcslam.sources.bags.options import BagOptions
from fcslam.sources.logs.archive import head, robot_name, translate_errors
from fcslam.sources.logs.carmen import is_carmen
from fcslam.sources.logs.carmen_log import CarmenLog
from fcslam.sources.source import Source

if TYPE_CHECKING:
    from fcslam.sources.bags.rosbag import RosBag

LOG, BAG, CLOUDS = "CARMEN log", "ROS bag", "folder of point clouds"
IN_PLANE = (
    "{}: no point clouds, so its laser joins the 3D map: it fixes x, y and heading where a robot with a 3D LiDAR saw "
    "the same walls, and needs level floors; without such a robot, leave out --3d"
)
"""What a robot with 2D scans does in a map in space."""


def open_fleet(
    recordings: Iterable[tuple[Path | Source, str | None]], options: BagOptions | None = None
) -> list[Source]:
    """Open the recordings of one fleet, each with its robot's name, as ``open_source`` does.

    A bag of several robots gives each of them. Sources that are open already stay as they are.
    """
    sources: list[Source] = []
    for path, name in recordings:
        if not isinstance(path, Path) and name not in (None, path.name):
            raise SourceError(f"{name}: its recording is open under the name {path.name}; open it as {name}")
        source = open_source(path, options, name) if isinstance(path, Path) else path
        bag = bag_of(source) if isinstance(path, Path) else None
        sources += [source] if bag is None else bag.robots(name)
    return [whole_clouds(source, options) for source in sources]


def whole_clouds(source: Source, options: BagOptions | None) -> Source:
    """A recording as it is, or with ``in_3d`` its clouds whole."""
    bag = bag_of(source) if options is not None and options.in_3d else None
    if bag is None:
        return source
    from fcslam.sources.bags.cloud_bag import in_3d

    return in_3d(bag)


def is_whole(source: Source) -> bool:
    """Whether the clouds of a recording are read whole, for a robot with a 3D LiDAR."""
    from fcslam.sources.clouds_in_space import CloudRecording

    return isinstance(source, CloudRecording)


def bag_of(source: Source) -> "RosBag | None":
    """A source that is a bag; None for any other. The readers of bags load with the first bag."""
    if isinstance(source, CarmenLog):
        return None
    from fcslam.sources.bags.rosbag import RosBag

    return source if isinstance(source, RosBag) else None


def robot_in(path: Path) -> tuple[Path, str | None]:
    """The file of a recording, and which robot of it ``path`` names, as in ``fleet.bag:/robot1``."""
    file, colon, robot = str(path).rpartition(":")
    if not colon or os.path.lexists(path) or not all(map(os.path.lexists, parts_of(Path(file)))):
        return path, None
    return Path(file), f"/{robot.strip('/')}"


def open_source(path: Path, options: BagOptions | None = None, name: str | None = None) -> Source:
    """Open the recording at ``path``. Its content decides the format, not its name.

    Only the beginning is read; ``Source.survey`` checks the rest.

    Args:
        path: file or folder; several files of one bag, joined by commas. A robot of a bag that has several is named
            after a colon, as in ``fleet.bag:/robot1``.
        options: options of a bag.
        name: the robot's name; None takes the name of the robot in the bag, or of the file.

    Raises:
        SourceError: the file is missing, empty, unreadable, a damaged archive or of an unknown format; or ``options``
            are given for a recording that is not a bag.
    """
    path, robot = robot_in(Path(path))
    known = format_of(path)
    if known == CLOUDS:
        from fcslam.sources.cloud_files import CloudFolder

        if options is None or not options.in_3d:
            raise SourceError(f"{path}: holds clouds of a 3D LiDAR; map them with --3d")
        return CloudFolder(path, name or _robot_name(path))
    if known == LOG:
        if options not in (None, BagOptions(in_3d=True)) or robot is not None:
            raise SourceError(
                f"{path}: a {LOG} has neither topics nor tf; --sensors and a robot after a colon go with ROS bags "
                "only, leave them out"
            )
        return CarmenLog(path, name or _robot_name(path))
    from fcslam.sources.bags.rosbag import RosBag

    if robot is not None:
        options = replace(options or BagOptions(), robot=robot)
        name = name or robot.strip("/").replace("/", "_")
    return RosBag(path, name or _robot_name(path), options)


def _robot_name(path: Path) -> str:
    names = [robot_name(path)] if os.path.isdir(path) else list(map(robot_name, parts_of(path)))
    return os.path.commonprefix(names).strip("._-") or names[0]  # noqa: RUF071  of letters


def format_of(path: Path) -> str:
    """The format of the recording at ``path``, ``LOG``, ``BAG`` or ``CLOUDS``, by its content."""
    parts = parts_of(path)
    if len(parts) > 1 and not os.path.isdir(path):
        for part in parts:
            if format_of(part) == LOG:
                raise SourceError(f"{part}: a {LOG} is not a part of several; give one recording, or parts of a bag")
        return BAG
    is_folder = os.path.isdir(path)
    content = b"" if is_folder else head(path)
    if content.startswith(b"PK\x03\x04"):
        raise SourceError(f"{path}: is a zip archive; unpack it, and give the recording in it")
    if is_carmen(content):
        return LOG
    with translate_errors(path):
        if is_bag(path, content):
            return BAG
    known = f"{LOG} or {BAG}"
    if is_folder:
        from fcslam.sources.cloud_files import cloud_files

        if cloud_files(path):
            return CLOUDS
        raise SourceError(f"{path}: is a folder, not a recording; give the file of a recording ({known})")
    if path.name == "metadata.yaml":
        raise SourceError(f"{path}: describes a bag; give its folder, {path.parent}")
    raise SourceError(f"{path}: not a recording of a known format; give a {known}")
