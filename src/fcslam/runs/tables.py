"""The tables of a run folder: trajectories (TUM), robots, closures, metrics.

Readers raise ValueError for a file that is not such a table; ``within``: see ``untrusted.open_file``.
"""

import csv
import io
import json
import math
from collections.abc import Iterable, Mapping
from dataclasses import astuple, fields
from pathlib import Path
from typing import Any, BinaryIO, TypeVar

import numpy as np

from fcslam.errors import InputError
from fcslam.geometry import se3
from fcslam.records import FLOOR, Channel, ClosureStatus, FloatArray, Reason, ReasonCode, frozen
from fcslam.runs.records import ClosureRow, Join, LocalizedPoses, Metric, RobotTrajectory
from fcslam.untrusted import read_text

_Value = TypeVar("_Value")

_ROBOT_COLUMNS = ["robot", "map", "path_length_m", "scans"]
_FLOOR = "floor"
"""Last column of robots.csv, if a robot names its floor."""
_LOCALIZED_COLUMNS = ["stamp", "x", "y", "theta", "sigma_x", "sigma_y", "sigma_theta", "quality"]
_CLOSURE_COLUMNS = [
    *("robot_i", "stamp_i", "robot_j", "stamp_j", "channel", "similarity", "x", "y", "theta"),
    *("status", "reason", "value", "limit", "setting"),
]
_JOIN_COLUMNS = [field.name for field in fields(Join)]
_SPACE_LINE = "%.9f" + 7 * " %.9f" + "\n"
_TUM_LINE = "%.9f %.9f %.9f 0 0 0 %.9f %.9f\n"


def write_tum(path: Path | BinaryIO, stamps: FloatArray, T_map_base: FloatArray) -> None:
    """Write poses as TUM lines ``stamp x y z qx qy qz qw``, nine digits after the point.

    Shape (N, 7), or (N, 3) in the plane.
    """
    if T_map_base.shape[1] == 7:
        line, rows = _SPACE_LINE, np.column_stack((stamps, T_map_base))
    else:
        half = T_map_base[:, 2] / 2.0
        line, rows = _TUM_LINE, np.column_stack((stamps, T_map_base[:, :2], np.sin(half), np.cos(half)))
    text = "".join(line % tuple(row) for row in rows.tolist()).encode()
    if isinstance(path, Path):
        path.write_bytes(text)
    else:
        path.write(text)


def read_tum(path: Path, within: Path | None = None) -> tuple[FloatArray, FloatArray]:
    """Stamps (N,) and poses (N, 3) in the plane of a TUM file, in its order."""
    stamps, poses = read_tum_6d(path, within)
    return stamps, frozen(se3.to_plane(poses))


def read_tum_6d(path: Path, within: Path | None = None) -> tuple[FloatArray, FloatArray]:
    """Stamps (N,) and poses (N, 7) of a TUM file, in its order."""
    try:
        rows = [_tum_fields(line) for line in read_text(path, within).splitlines() if line.strip()]
        table = np.array(rows, dtype=np.float64).reshape(-1, 8)
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: not a TUM trajectory ({error})") from error
    if not np.all(np.isfinite(table)):
        raise InputError(f"{path}: not a TUM trajectory (a number that is not finite)")
    return frozen(table[:, 0]), frozen(table[:, 1:])


def _tum_fields(line: str) -> list[float]:
    fields = [float(text) for text in line.split()]
    if len(fields) != 8:
        raise ValueError(f"a line of {len(fields)} numbers, expected 8")
    return fields


def write_robots(path: Path, trajectories: Iterable[RobotTrajectory]) -> None:
    """Write robots.csv."""
    robots = list(trajectories)
    columns = [*_ROBOT_COLUMNS, _FLOOR] if any(robot.floor for robot in robots) else _ROBOT_COLUMNS
    fields = ([r.robot, r.map_index, f"{r.path_length_m:.3f}", len(r.stamps), r.floor] for r in robots)
    _write_csv(path, columns, (row[: len(columns)] for row in fields))


def read_robots(path: Path, within: Path) -> dict[str, tuple[int, str]]:
    """Map index and floor by robot, in the order of robots.csv."""
    rows = _read_csv(path, _ROBOT_COLUMNS, within)
    return _unique(path.name, ((row["robot"], (int(row["map"]), _floor(row.get(_FLOOR) or ""))) for row in rows))


def _floor(text: str) -> str:
    if text and not FLOOR.fullmatch(text):
        raise ValueError(f"{text[:64]!r} is not a floor")
    return text


def write_closures(path: Path, closures: Iterable[ClosureRow]) -> None:
    """Write closures.csv."""
    _write_csv(path, _CLOSURE_COLUMNS, map(_closure_fields, closures))


def read_closures(path: Path, within: Path, trajectories: Mapping[str, RobotTrajectory]) -> tuple[ClosureRow, ...]:
    """Every line of closures.csv; both ends are on ``trajectories``."""
    closures = tuple(_read_closure(row) for row in _read_csv(path, _CLOSURE_COLUMNS, within))
    for robot in {robot for closure in closures for robot in (closure.robot_i, closure.robot_j)}:
        if robot not in trajectories or not len(trajectories[robot].stamps):
            raise ValueError(f"{path.name}: '{robot[:64]}' has no trajectory")
    return closures


def write_joins(path: Path, joins: Iterable[Join]) -> None:
    """Write joins.csv; empty cells where the maps were not compared."""
    _write_csv(path, _JOIN_COLUMNS, ([_cell(value) for value in astuple(join)] for join in joins))


def _cell(value: str | float) -> str | float:
    if not isinstance(value, float):
        return value
    return "" if math.isnan(value) else f"{value:.6f}"


def read_joins(path: Path, within: Path) -> tuple[Join, ...]:
    """Every line of joins.csv."""
    return tuple(
        Join(
            row["robot_i"],
            row["robot_j"],
            int(row["closures"]),
            int(row["places"]),
            *(float(row[column] or "nan") for column in _JOIN_COLUMNS[4:]),
        )
        for row in _read_csv(path, _JOIN_COLUMNS, within)
    )


def write_localized(path: Path, poses: LocalizedPoses) -> None:
    """Write localization/<robot>.csv: nine digits after the point, empty cells where the robot was not localized."""
    table = np.column_stack((poses.stamps, poses.T_map_base, poses.sigma, poses.quality)).tolist()
    fields = (["" if math.isnan(value) else f"{value:.9f}" for value in row] for row in table)
    _write_csv(path, _LOCALIZED_COLUMNS, fields)


def read_localized(path: Path, within: Path) -> LocalizedPoses:
    """Every line of localization/<robot>.csv."""
    rows = [
        [float(row[column] or "nan") for column in _LOCALIZED_COLUMNS]
        for row in _read_csv(path, _LOCALIZED_COLUMNS, within)
    ]
    table: FloatArray = frozen(np.array(rows, dtype=np.float64).reshape(-1, len(_LOCALIZED_COLUMNS)))
    return LocalizedPoses(path.stem, table[:, 0], table[:, 1:4], table[:, 4:7], table[:, 7])


def metrics_json(metrics: Iterable[Metric]) -> str:
    """JSON has no NaN: a metric without a value is null."""
    rows = [
        {"name": metric.name, "value": metric.value if math.isfinite(metric.value) else None, "unit": metric.unit}
        for metric in metrics
    ]
    return json.dumps(rows, indent=2) + "\n"


def read_metrics(path: Path, within: Path) -> dict[str, Metric]:
    """Every metric of metrics.json by its name; null is NaN."""
    try:
        rows = json.loads(read_text(path, within))
        values = [math.nan if row["value"] is None else _number(row["value"]) for row in rows]
        return _unique(
            path.name, ((row["name"], Metric(row["name"], v, row["unit"])) for row, v in zip(rows, values, strict=True))
        )
    except (KeyError, TypeError, OverflowError, RecursionError) as error:
        raise ValueError(f"{path.name} is not a list of name, value, unit") from error


def _number(value: object) -> float:
    if not isinstance(value, int | float):
        raise TypeError(f"{value!r} is not a number")
    float(value)  # raises OverflowError for an integer beyond all floats
    return value


def _unique(file: str, items: Iterable[tuple[str, _Value]]) -> dict[str, _Value]:
    found: dict[str, _Value] = {}
    for name, value in items:
        if name in found:
            raise ValueError(f"{file}: '{name}' occurs twice")
        found[name] = value
    return found


def _closure_fields(closure: ClosureRow) -> list[Any]:
    ends = [closure.robot_i, f"{closure.stamp_i:.9f}", closure.robot_j, f"{closure.stamp_j:.9f}"]
    numbers = [f"{number:.6f}" for number in (closure.similarity, *closure.T_i_j)]
    reason = closure.reason
    known = ["" if number is None else f"{number:.6g}" for number in (reason.value, reason.limit)]
    return [*ends, closure.channel.value, *numbers, closure.status.value, reason.code.value, *known, reason.setting]


def _read_closure(row: dict[str, str]) -> ClosureRow:
    value, limit = (float(row[column]) if row[column] else None for column in ("value", "limit"))
    return ClosureRow(
        robot_i=row["robot_i"],
        stamp_i=float(row["stamp_i"]),
        robot_j=row["robot_j"],
        stamp_j=float(row["stamp_j"]),
        channel=Channel(row["channel"]),
        similarity=float(row["similarity"]),
        T_i_j=frozen([float(row[axis]) for axis in ("x", "y", "theta")]),
        status=ClosureStatus(row["status"]),
        reason=Reason(ReasonCode(row["reason"]), value, limit, row["setting"]),
    )


def _write_csv(path: Path, columns: list[str], rows: Iterable[list[Any]]) -> None:
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(columns)
        writer.writerows(rows)


def _read_csv(path: Path, columns: list[str], within: Path) -> list[dict[str, str]]:
    reader = csv.DictReader(io.StringIO(read_text(path, within), newline=""))
    rows, heading = list(reader), list(reader.fieldnames or ())
    if not rows and not set(columns) <= set(heading):
        raise ValueError(f"{path.name}, line 1: expected the columns {', '.join(columns)}")
    for number, row in enumerate(rows, start=2):
        if any(row.get(column) is None for column in columns):
            raise ValueError(f"{path.name}, line {number}: expected the columns {', '.join(columns)}")
    return rows
