"""The run folder: what a mission leaves behind. Writer and reader stand side by side.

    trajectories/<robot>.tum   stamp x y z qx qy qz qw: pose of base in the robot's map at every laser scan
    robots.csv                 robot, map, path_length_m, scans, floor
    joins.csv                  on what evidence robots share a map, a line for each two with closures between them
    closures.csv               every loop closure considered, with its status and reason
    pose_graph.g2o             the optimized pose graph
    metrics.json               [{name, value, unit}]
    config.yaml                the complete configuration of the run
    quality.json               the certificate: expected error of each square metre, what to drive
    mission.fcslam             packets, edits and configuration of the mission, with which it can go on
    map.ply                    of robots with 3D LiDARs: points with normals, coloured by height
    map.pgm, map.yaml ...      map files, map_<k>.* for robots not connected to the first map
    rmf.yaml                   of a map that lies in a floor plan: where Open-RMF has it
    localization/<robot>.csv   instead of local: of a robot that was localized in a finished map, pose, standard
                               deviations and quality at every laser scan
    local/<robot>.tum          as trajectories/, in the robot's own map, which nothing but its own measurements made
    local/<robot>.pgm, .yaml   that map

A run folder is whole or not there: it is written into a hidden folder beside its place and renamed at the end.
"""

import csv
import os
import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

from fcslam.errors import InputError, writing
from fcslam.geometry import se3
from fcslam.maps.occupancy_map import RMF_YAML, OccupancyMap, parse_map
from fcslam.records import StrPath, frozen
from fcslam.runs.records import LocalizedPoses, LocalMap, RobotTrajectory, RunTables
from fcslam.runs.tables import (
    metrics_json,
    read_closures,
    read_joins,
    read_localized,
    read_metrics,
    read_robots,
    read_tum,
    read_tum_6d,
    write_closures,
    write_joins,
    write_localized,
    write_robots,
    write_tum,
)
from fcslam.runs.verdict import QUALITY, MapVerdict, verdicts
from fcslam.storage.files import bring_back, replacing_folder
from fcslam.untrusted import read_bytes, read_text

TRAJECTORIES, LOCAL, ROBOTS, CLOSURES, JOINS = "trajectories", "local", "robots.csv", "closures.csv", "joins.csv"
LOCALIZATION, MISSION = "localization", "mission.fcslam"
METRICS, CONFIG, POSE_GRAPH = "metrics.json", "config.yaml", "pose_graph.g2o"

_SAFE_NAME = re.compile(r"\w[\w.+-]*")
_MAP_FILE = re.compile(r"map(?:_([1-9]\d{0,8}))?\.pgm")
"""Map 0 has no number in its name."""


@dataclass(frozen=True, eq=False)
class Run(RunTables):
    """The result of a mission: what ``fcslam.map_recordings`` returns and ``fcslam.open_run`` reads.

    Poses are (x, y, theta) of the robot's ``base`` in metres and radians; ``T_a_b`` maps coordinates in b to a. Robots
    whose relative pose is not supported by enough closures are in separate maps, each with its own coordinate frame.
    Files hold poses and stamps with nine digits after the decimal point and closures with six.
    """

    pose_graph_g2o: str = ""
    """All keyscans at their optimized poses with the constraints in use, in the g2o format."""
    map_files: Mapping[str, bytes] = field(default_factory=dict)
    """File name to content: map.pgm, map.yaml, map.png, map_1.pgm ..."""
    local_maps: Mapping[str, LocalMap] = field(default_factory=dict)
    """By robot: every robot's own map. Live results of the service have none, and their folder has no ``local``."""
    quality: bytes = b""
    """Content of quality.json, the certificate of each map; empty: not computed."""
    mission: bytes = b""
    """The mission file: packets and edits, with which the mission can go on. Live results of the service have none."""
    localized: Mapping[str, LocalizedPoses] = field(default_factory=dict)
    """By robot: poses in a finished map; ``fcslam.localize`` makes them."""

    @cached_property
    def maps(self) -> Mapping[int, OccupancyMap]:
        """The occupancy maps, by index; most robots are in map 0. Decoded at the first use."""
        decoded = {}
        for name, pgm in self.map_files.items():
            if match := _MAP_FILE.fullmatch(name):
                description = self.map_files.get(f"{name.removesuffix('.pgm')}.yaml", b"").decode(errors="replace")
                decoded[int(match[1] or 0)] = parse_map(name, pgm, description)
        return dict(sorted(decoded.items()))

    @cached_property
    def verdict(self) -> tuple[MapVerdict, ...]:
        """The verdict on each map, by number; ``str`` of one is its sentence. Computed at the first use."""
        return verdicts(self, self.quality)

    def save(self, folder: StrPath, force: bool = False) -> None:
        """Write the run folder, whole or not at all.

        Args:
            folder: the folder to make; its parents are made too.
            force: replace a run that is there.

        Raises:
            InputError: the folder exists without ``force``, or cannot be written.
        """
        check_names([*self.trajectories, *self.local_maps, *self.map_files])
        place = prepare_output(Path(folder), force)
        with writing(place, "name another folder"), replacing_folder(place) as staging:
            _write(self, staging)


def prepare_output(path: Path, force: bool = False) -> Path:
    """Check, before the long work, that a run folder can be put at ``path``; its parents are made."""
    return prepare_folder(path, force, "a run", is_run_folder)


def prepare_folder(path: Path, force: bool, content: str, holds_content: Callable[[Path], bool]) -> Path:
    """As ``prepare_output``, for a folder of which ``holds_content`` says whether it holds ``content``."""
    place = Path(os.path.realpath(path))  # Path.resolve raises for a link to itself
    try:
        place.parent.mkdir(parents=True, exist_ok=True)
        bring_back(place)
        occupied = os.path.lexists(place) and (not place.is_dir() or any(place.iterdir()))
    except OSError as error:
        raise InputError(f"{path}: cannot be used as the output folder ({error})") from error
    if not os.access(place.parent, os.W_OK):
        raise InputError(f"{path}: no permission to write in {place.parent}")
    if place == Path.cwd() or os.path.ismount(place):
        raise InputError(f"{path}: cannot be replaced as a whole; name a new folder inside it")
    if occupied and not (place.is_dir() and holds_content(place)):
        raise InputError(f"{path}: exists and does not hold {content}; name a new folder")
    if occupied and not force:
        raise InputError(
            f"{path}: already holds {content}; name a new folder or give --force (in Python force=True) to replace it"
        )
    return place


def check_names(names: Iterable[str]) -> None:
    """Check, before the long work, that robots' names can be file names."""
    for name in names:
        if not _SAFE_NAME.fullmatch(name):
            raise InputError(f"{name!r} cannot be a file name; use letters, digits, '_', '-', '+' and '.'")


def is_run_folder(path: Path) -> bool:
    """Whether ``path`` has the two entries that every run folder has. It may be one that no file can have."""
    return os.path.isfile(path / ROBOTS) and os.path.isdir(path / TRAJECTORIES)


def identity(folder: Path) -> tuple[int, int]:
    """Return an identifier that differs if another run folder replaces this one: no file in a run folder changes.

    Raises:
        FileNotFoundError: there is no run folder.
    """
    found = folder.stat()
    return found.st_ino, found.st_mtime_ns


def open_run(folder: StrPath, maps: bool = True) -> Run:
    """Read a run folder back; files are read, never executed.

    Args:
        folder: the run folder.
        maps: read the maps, the pose graph and the mission file too, which may be large.

    Raises:
        InputError: the folder is missing, damaged, or not a run folder.
    """
    path = Path(folder)
    if not os.path.exists(path):
        raise InputError(f"{path}: no such folder; check the path of the run")
    if not is_run_folder(path):
        raise InputError(f"{path}: not a run folder (it has no {ROBOTS} or no {TRAJECTORIES}/); `fcslam map` makes one")
    try:
        robots = read_robots(path / ROBOTS, path)
        pictures = [*path.glob("map*.*"), *path.glob("plan.*"), *path.glob(RMF_YAML)]
        own_maps = robots if maps and (path / LOCAL).exists() else ()
        trajectories = {robot: _read_trajectory(path, robot, *where) for robot, where in robots.items()}
        return Run(
            trajectories=trajectories,
            closures=read_closures(path / CLOSURES, path, trajectories),
            joins=read_joins(path / JOINS, path) if (path / JOINS).exists() else (),
            metrics=read_metrics(path / METRICS, path),
            config_yaml=read_text(path / CONFIG, path),
            pose_graph_g2o=read_text(path / POSE_GRAPH, path) if maps else "",
            map_files={file.name: read_bytes(file, path) for file in sorted(pictures) if maps},
            local_maps={robot: _read_local_map(path, robot) for robot in own_maps},
            quality=read_bytes(path / QUALITY, path) if (path / QUALITY).exists() else b"",
            mission=read_bytes(path / MISSION, path) if maps and (path / MISSION).exists() else b"",
            localized={file.stem: read_localized(file, path) for file in sorted((path / LOCALIZATION).glob("*.csv"))},
        )
    except (OSError, ValueError, csv.Error) as error:
        raise InputError(f"{path}: a damaged run folder ({error})") from error


def _write(run: Run, folder: Path) -> None:
    (folder / TRAJECTORIES).mkdir()
    for trajectory in run.trajectories.values():
        file = folder / TRAJECTORIES / f"{trajectory.robot}.tum"
        write_tum(file, trajectory.stamps, trajectory.poses)
    if run.local_maps:
        (folder / LOCAL).mkdir()
    for local in run.local_maps.values():
        own = folder / LOCAL / local.robot
        write_tum(Path(f"{own}.tum"), local.stamps, local.T_local_base)
        Path(f"{own}.pgm").write_bytes(local.pgm)
        Path(f"{own}.yaml").write_text(local.yaml, encoding="utf-8")
    if run.localized:
        (folder / LOCALIZATION).mkdir()
    for poses in run.localized.values():
        write_localized(folder / LOCALIZATION / f"{poses.robot}.csv", poses)
    if run.mission:
        (folder / MISSION).write_bytes(run.mission)
    write_robots(folder / ROBOTS, run.trajectories.values())
    write_closures(folder / CLOSURES, run.closures)
    write_joins(folder / JOINS, run.joins)
    (folder / METRICS).write_text(metrics_json(run.metrics.values()), encoding="utf-8")
    (folder / CONFIG).write_text(run.config_yaml, encoding="utf-8")
    (folder / POSE_GRAPH).write_text(run.pose_graph_g2o, encoding="utf-8")
    if run.quality:
        (folder / QUALITY).write_bytes(run.quality)
    for name, content in run.map_files.items():
        (folder / name).write_bytes(content)


def _read_trajectory(folder: Path, robot: str, map_index: int, floor: str) -> RobotTrajectory:
    if not _SAFE_NAME.fullmatch(robot):
        raise ValueError(f"{ROBOTS}: {robot!r} is not a robot's name")
    stamps, poses = read_tum_6d(folder / TRAJECTORIES / f"{robot}.tum", folder)
    in_space = poses if poses[:, 2:5].any() else None
    return RobotTrajectory(robot, map_index, stamps, frozen(se3.to_plane(poses)), floor, in_space)


def _read_local_map(run: Path, robot: str) -> LocalMap:
    folder = run / LOCAL
    stamps, poses = read_tum(folder / f"{robot}.tum", run)
    pgm, yaml = read_bytes(folder / f"{robot}.pgm", run), read_text(folder / f"{robot}.yaml", run)
    return LocalMap(robot, stamps, poses, pgm, yaml)
