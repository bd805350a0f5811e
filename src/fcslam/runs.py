"""The run folder: what a mission leaves behind. Writer and reader stand side by side.

    trajectories/<robot>.tum   stamp x y z qx qy qz qw: pose of base in the robot's map at every laser scan
    robots.csv                 robot, map, path_length_m, scans
    closures.csv               every loop closure considered, with its status and reason
    pose_graph.g2o             the optimised pose graph
    metrics.json               [{name, value, unit}]
    config.yaml                the complete configuration of the run
    map.pgm, map.yaml ...      map files, map_<k>.* for robots not connected to the first map
    local/<robot>.tum          as trajectories/, in the robot's own map, which nothing but its own measurements made
    local/<robot>.pgm, .yaml   that map

A run folder is whole or not there: it is written into a hidden folder beside its place and renamed at the end.
"""

import csv
import json
import math
import os
import re
import shutil
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from fcslam.errors import ConfigError, EvaluationError, OutputError
from fcslam.records import Channel, ClosureStatus, FloatArray, Veto, frozen

TRAJECTORIES, LOCAL, ROBOTS, CLOSURES = "trajectories", "local", "robots.csv", "closures.csv"
METRICS, CONFIG, POSE_GRAPH = "metrics.json", "config.yaml", "pose_graph.g2o"

_ROBOT_COLUMNS = ["robot", "map", "path_length_m", "scans"]
_CLOSURE_ENDS = ["robot_i", "stamp_i", "robot_j", "stamp_j"]
_CLOSURE_COLUMNS = [*_CLOSURE_ENDS, "channel", "similarity", "x", "y", "theta", "status", "reason"]
_SAFE_NAME = re.compile(r"\w[\w.+-]*")


@dataclass(frozen=True, slots=True)
class RobotTrajectory:
    """Where one robot was at every laser scan of its recording, in the scans' order."""

    robot: str
    map_index: int
    stamps: FloatArray
    """Shape (N,), the recording's own stamps."""
    T_map_base: FloatArray
    """Shape (N, 3), in the coordinate frame of map ``map_index``."""

    @property
    def path_length_m(self) -> float:
        """Length of the polygon through the positions."""
        steps = np.diff(self.T_map_base[:, :2], axis=0)
        return float(np.sum(np.hypot(steps[:, 0], steps[:, 1])))


@dataclass(frozen=True, slots=True)
class LocalMap:
    """One robot's own map: what it knew before any other robot's measurements; the origin is its first keyscan."""

    robot: str
    stamps: FloatArray
    """Shape (N,), as in the robot's trajectory."""
    T_local_base: FloatArray
    """Shape (N, 3), at every laser scan."""
    pgm: bytes
    yaml: str
    """For ROS map_server; names the PGM file ``<robot>.pgm``."""


@dataclass(frozen=True, slots=True)
class ClosureRow:
    """One loop closure as closures.csv tells it."""

    robot_i: str
    stamp_i: float
    robot_j: str
    stamp_j: float
    channel: Channel
    similarity: float
    """In [0, 1]."""
    T_i_j: FloatArray
    status: ClosureStatus
    reason: str


@dataclass(frozen=True, slots=True)
class Metric:
    """A named number with its unit."""

    name: str
    value: float
    unit: str


@dataclass(frozen=True)
class Run:
    """Everything in a run folder."""

    trajectories: tuple[RobotTrajectory, ...]
    closures: tuple[ClosureRow, ...] = ()
    metrics: tuple[Metric, ...] = ()
    config_yaml: str = ""
    pose_graph_g2o: str = ""
    map_files: Mapping[str, bytes] = field(default_factory=dict)
    """File name to content: map.pgm, map.yaml, map.png, map_1.pgm ..."""
    local_maps: tuple[LocalMap, ...] = ()
    """Of every robot, in the order of the trajectories; or none, and the folder has no ``local``."""


def prepare_output(path: Path, force: bool = False) -> Path:
    """Check, before the long work, that a run folder can be put at ``path``; its parents are made.

    Raises:
        OutputError: something else is there, a run is there and ``force`` is not given, or it cannot be written.
    """
    place = path.resolve()
    try:
        place.parent.mkdir(parents=True, exist_ok=True)
        occupied = place.exists() and (not place.is_dir() or any(place.iterdir()))
    except OSError as error:
        raise OutputError(f"{path}: cannot be used as the output folder ({error})") from error
    if not os.access(place.parent, os.W_OK):
        raise OutputError(f"{path}: no permission to write in {place.parent}")
    if place == Path.cwd() or os.path.ismount(place):
        raise OutputError(f"{path}: cannot be replaced as a whole; name a new folder inside it")
    if occupied and not (place.is_dir() and is_run_folder(place)):
        raise OutputError(f"{path}: exists and is no run folder; name a new folder")
    if occupied and not force:
        raise OutputError(f"{path}: already holds a run; name a new folder or give --force to replace it")
    return place


def check_names(names: Iterable[str]) -> None:
    """Check, before the long work, that robots' names can be file names.

    Raises:
        OutputError: one cannot.
    """
    for name in names:
        if not _SAFE_NAME.fullmatch(name):
            raise OutputError(f"{name!r} cannot be a file name; use letters, digits, '_', '-', '+' and '.'")


def is_run_folder(path: Path) -> bool:
    """Whether ``path`` has the two entries that every run folder has."""
    return (path / ROBOTS).is_file() and (path / TRAJECTORIES).is_dir()


def write_run(run: Run, path: Path, force: bool = False) -> None:
    """Write ``run`` as the folder ``path``, whole or not at all.

    Raises:
        OutputError: as in ``prepare_output``, a name cannot be a file's, or writing fails.
    """
    robots = [trajectory.robot for trajectory in run.trajectories] + [local.robot for local in run.local_maps]
    check_names([*robots, *run.map_files])
    with _staged(prepare_output(path, force)) as folder:
        (folder / TRAJECTORIES).mkdir()
        for trajectory in run.trajectories:
            write_tum(_tum_path(folder, trajectory.robot), trajectory.stamps, trajectory.T_map_base)
        if run.local_maps:
            (folder / LOCAL).mkdir()
        for local in run.local_maps:
            _write_local_map(folder / LOCAL, local)
        _write_csv(folder / ROBOTS, _ROBOT_COLUMNS, map(_robot_fields, run.trajectories))
        _write_csv(folder / CLOSURES, _CLOSURE_COLUMNS, map(_closure_fields, run.closures))
        (folder / METRICS).write_text(metrics_json(run.metrics), encoding="utf-8")
        (folder / CONFIG).write_text(run.config_yaml, encoding="utf-8")
        (folder / POSE_GRAPH).write_text(run.pose_graph_g2o, encoding="utf-8")
        for name, content in run.map_files.items():
            (folder / name).write_bytes(content)


def open_run(path: Path) -> Run:
    """Read a run folder back.

    Raises:
        EvaluationError: ``path`` is no run folder, or a file of it is missing or broken.
    """
    if not is_run_folder(path):
        raise EvaluationError(
            f"{path}: no run folder (it has no {ROBOTS} or no {TRAJECTORIES}/); `fcslam map` makes one"
        )
    try:
        trajectories = tuple(_read_trajectory(path, row) for row in _read_csv(path / ROBOTS, _ROBOT_COLUMNS))
        return Run(
            trajectories=trajectories,
            closures=tuple(_read_closure(row) for row in _read_csv(path / CLOSURES, _CLOSURE_COLUMNS)),
            metrics=_read_metrics(path / METRICS),
            config_yaml=(path / CONFIG).read_text(encoding="utf-8"),
            pose_graph_g2o=(path / POSE_GRAPH).read_text(encoding="utf-8"),
            map_files={file.name: file.read_bytes() for file in sorted(path.glob("map*.*"))},
            local_maps=_read_local_maps(path / LOCAL, [trajectory.robot for trajectory in trajectories]),
        )
    except (OSError, ValueError, csv.Error) as error:
        raise EvaluationError(f"{path}: a broken run folder ({error})") from error


def read_vetoes(path: Path) -> tuple[Veto, ...]:
    """Closures that must not count: lines of a run's closures.csv, of which only the two ends are read.

    A line without stamps speaks of every closure between the two robots.

    Raises:
        ConfigError: the file cannot be read, a column is missing, or a stamp is no number.
    """
    try:
        return tuple(_read_veto(number, row) for number, row in enumerate(_read_csv(path, _CLOSURE_ENDS), start=2))
    except (OSError, ValueError, csv.Error) as error:
        raise ConfigError(f"{path}: no list of vetoes ({error}); copy lines of a run's {CLOSURES}") from error


def _read_veto(number: int, row: dict[str, str]) -> Veto:
    stamps = [row["stamp_i"].strip(), row["stamp_j"].strip()]
    if not any(stamps):
        return Veto(row["robot_i"], row["robot_j"])
    try:
        stamp_i, stamp_j = map(float, stamps)
    except ValueError:
        stamp_i = stamp_j = math.nan
    if not (math.isfinite(stamp_i) and math.isfinite(stamp_j)):
        raise ValueError(f"line {number}: two stamps or none are needed, not '{stamps[0]}' and '{stamps[1]}'")
    return Veto(row["robot_i"], row["robot_j"], (stamp_i, stamp_j))


def write_tum(path: Path | BinaryIO, stamps: FloatArray, T_map_base: FloatArray) -> None:
    """Write poses (N, 3) as TUM lines ``stamp x y 0 0 0 qz qw``, nine digits after the point."""
    half = T_map_base[:, 2] / 2.0
    zeros = np.zeros(len(half))
    columns = (stamps, T_map_base[:, 0], T_map_base[:, 1], zeros, zeros, zeros, np.sin(half), np.cos(half))
    np.savetxt(path, np.column_stack(columns), fmt="%.9f %.9f %.9f %d %d %d %.9f %.9f")


def read_tum(path: Path) -> tuple[FloatArray, FloatArray]:
    """Stamps (N,) and poses (N, 3) of a TUM file, in its order.

    Raises:
        EvaluationError: the file cannot be read or a line is not eight finite numbers.
    """
    try:
        rows = [_tum_fields(line) for line in path.read_text(encoding="utf-8").splitlines() if line.strip()]
        table = np.array(rows, dtype=np.float64).reshape(-1, 8)
    except (OSError, ValueError) as error:
        raise EvaluationError(f"{path}: not a TUM trajectory ({error})") from error
    if not np.all(np.isfinite(table)):
        raise EvaluationError(f"{path}: not a TUM trajectory (a number that is not finite)")
    theta = 2.0 * np.arctan2(table[:, 6], table[:, 7])
    poses = np.column_stack((table[:, 1], table[:, 2], np.arctan2(np.sin(theta), np.cos(theta))))
    return frozen(table[:, 0]), frozen(poses)


def _tum_fields(line: str) -> list[float]:
    fields = [float(text) for text in line.split()]
    if len(fields) != 8:
        raise ValueError(f"a line of {len(fields)} numbers, expected 8")
    return fields


@contextmanager
def _staged(place: Path) -> Iterator[Path]:
    """A hidden folder beside ``place`` that becomes ``place`` when the block ends well, and vanishes when not."""
    staging = place.with_name(f".{place.name}.{os.getpid()}.partial")
    retired = place.with_name(f".{place.name}.{os.getpid()}.retired")
    try:
        staging.mkdir()
        yield staging
        _replace(place, staging, retired)
    except OSError as error:
        raise OutputError(f"{place}: cannot write the run ({error})") from error
    finally:
        shutil.rmtree(staging, ignore_errors=True)
        shutil.rmtree(retired, ignore_errors=True)


def _replace(place: Path, staging: Path, retired: Path) -> None:
    """Put ``staging`` in the place of whatever is there; if that fails, what was there comes back."""
    if place.exists():
        place.rename(retired)
    try:
        staging.rename(place)
    except BaseException:
        if retired.exists():
            retired.rename(place)
        raise


def _tum_path(folder: Path, robot: str) -> Path:
    return folder / TRAJECTORIES / f"{robot}.tum"


def _robot_fields(trajectory: RobotTrajectory) -> list[Any]:
    return [trajectory.robot, trajectory.map_index, f"{trajectory.path_length_m:.3f}", len(trajectory.stamps)]


def _read_trajectory(folder: Path, row: dict[str, str]) -> RobotTrajectory:
    if not _SAFE_NAME.fullmatch(row["robot"]):
        raise ValueError(f"{ROBOTS}: {row['robot']!r} is no robot's name")
    stamps, poses = read_tum(_tum_path(folder, row["robot"]))
    return RobotTrajectory(row["robot"], int(row["map"]), stamps, poses)


def _write_local_map(folder: Path, local: LocalMap) -> None:
    write_tum(folder / f"{local.robot}.tum", local.stamps, local.T_local_base)
    (folder / f"{local.robot}.pgm").write_bytes(local.pgm)
    (folder / f"{local.robot}.yaml").write_text(local.yaml, encoding="utf-8")


def _read_local_maps(folder: Path, robots: Iterable[str]) -> tuple[LocalMap, ...]:
    return tuple(_read_local_map(folder, robot) for robot in robots) if folder.exists() else ()


def _read_local_map(folder: Path, robot: str) -> LocalMap:
    stamps, poses = read_tum(folder / f"{robot}.tum")
    pgm, yaml = (folder / f"{robot}.pgm").read_bytes(), (folder / f"{robot}.yaml").read_text(encoding="utf-8")
    return LocalMap(robot, stamps, poses, pgm, yaml)


def _closure_fields(closure: ClosureRow) -> list[Any]:
    ends = [closure.robot_i, f"{closure.stamp_i:.9f}", closure.robot_j, f"{closure.stamp_j:.9f}"]
    numbers = [f"{number:.6f}" for number in (closure.similarity, *closure.T_i_j)]
    return [*ends, closure.channel.value, *numbers, closure.status.value, closure.reason]


def _read_closure(row: dict[str, str]) -> ClosureRow:
    return ClosureRow(
        robot_i=row["robot_i"],
        stamp_i=float(row["stamp_i"]),
        robot_j=row["robot_j"],
        stamp_j=float(row["stamp_j"]),
        channel=Channel(row["channel"]),
        similarity=float(row["similarity"]),
        T_i_j=frozen([float(row[axis]) for axis in ("x", "y", "theta")]),
        status=ClosureStatus(row["status"]),
        reason=row["reason"],
    )


def metrics_json(metrics: Iterable[Metric]) -> str:
    """JSON has no NaN: a metric without a value is null."""
    rows = [
        {"name": metric.name, "value": metric.value if math.isfinite(metric.value) else None, "unit": metric.unit}
        for metric in metrics
    ]
    return json.dumps(rows, indent=2) + "\n"


def _read_metrics(path: Path) -> tuple[Metric, ...]:
    try:
        rows = json.loads(path.read_text(encoding="utf-8"))
        values = [math.nan if row["value"] is None else float(row["value"]) for row in rows]
        return tuple(Metric(row["name"], value, row["unit"]) for row, value in zip(rows, values, strict=True))
    except (KeyError, TypeError) as error:
        raise ValueError(f"{path.name} is not a list of name, value, unit") from error


def _write_csv(path: Path, columns: list[str], rows: Iterable[list[Any]]) -> None:
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(columns)
        writer.writerows(rows)


def _read_csv(path: Path, columns: list[str]) -> list[dict[str, str]]:
    with path.open(encoding="utf-8", newline="") as file:
        reader = csv.DictReader(file)
        rows, heading = list(reader), list(reader.fieldnames or ())
    if not rows and not set(columns) <= set(heading):
        raise ValueError(f"{path.name}, line 1: expected the columns {', '.join(columns)}")
    for number, row in enumerate(rows, start=2):
        if any(row.get(column) is None for column in columns):
            raise ValueError(f"{path.name}, line {number}: expected the columns {', '.join(columns)}")
    return rows
