"""The tables of a run folder: robots, closures, metrics."""

import csv
import io
import json
import math
from collections.abc import Iterable
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from fcslam.records import FLOOR, Channel, ClosureStatus, FloatArray, Reason, ReasonCode, frozen
from fcslam.runs.records import ClosureRow, LocalizedPoses, Metric, RobotTrajectory
from fcslam.untrusted import read_text

_Value = TypeVar("_Value")

_ROBOT_COLUMNS = ["robot", "map", "path_length_m", "scans"]
_FLOOR = "floor"
"""Last column of robots.csv, if a robot names its floor."""
_CLOSURE_ENDS = ["robot_i", "stamp_i", "robot_j", "stamp_j"]
_LOCALIZED_COLUMNS = ["stamp", "x", "y", "theta", "sigma_x", "sigma_y", "sigma_theta", "quality"]
_REASON_COLUMNS = ["reason", "value", "limit", "setting"]
_CLOSURE_COLUMNS = [*_CLOSURE_ENDS, "channel", "similarity", "x", "y", "theta", "status", *_REASON_COLUMNS]


def write_robots(path: Path, trajectories: Iterable[RobotTrajectory]) -> None:
    """Write robots.csv."""
    robots = list(trajectories)
    columns = [*_ROBOT_COLUMNS, _FLOOR] if any(robot.floor for robot in robots) else _ROBOT_COLUMNS
    _write_csv(path, columns, (_robot_fields(robot)[: len(columns)] for robot in robots))


def read_robots(path: Path, within: Path | None = None) -> dict[str, tuple[int, str]]:
    """Map index and floor by robot, in the order of robots.csv; ``within``: see ``untrusted.open_file``.

    Raises:
        ValueError: a column is missing, a map index or a floor is not valid, or a robot occurs twice.
    """
    rows = _read_csv(path, _ROBOT_COLUMNS, within)
    return _unique(path.name, ((row["robot"], (int(row["map"]), _floor(row.get(_FLOOR) or ""))) for row in rows))


def _floor(text: str) -> str:
    if text and not FLOOR.fullmatch(text):
        raise ValueError(f"{text[:64]!r} is not a floor")
    return text


def write_closures(path: Path, closures: Iterable[ClosureRow]) -> None:
    """Write closures.csv."""
    _write_csv(path, _CLOSURE_COLUMNS, map(_closure_fields, closures))


def read_closures(path: Path, within: Path | None = None) -> tuple[ClosureRow, ...]:
    """Every line of closures.csv; ``within``: see ``untrusted.open_file``.

    Raises:
        ValueError: a column is missing or a value is not what the column holds.
    """
    return tuple(_read_closure(row) for row in _read_csv(path, _CLOSURE_COLUMNS, within))


def write_localized(path: Path, poses: LocalizedPoses) -> None:
    """Write localization/<robot>.csv: nine digits after the point, empty cells where the robot was not localized."""
    table = np.column_stack((poses.stamps, poses.T_map_base, poses.sigma, poses.quality)).tolist()
    fields = (["" if math.isnan(value) else f"{value:.9f}" for value in row] for row in table)
    _write_csv(path, _LOCALIZED_COLUMNS, fields)


def read_localized(path: Path, within: Path | None = None) -> LocalizedPoses:
    """Every line of localization/<robot>.csv; ``within``: see ``untrusted.open_file``.

    Raises:
        ValueError: a column is missing or a value is not a number.
    """
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


def read_metrics(path: Path, within: Path | None = None) -> dict[str, Metric]:
    """Every metric of metrics.json by its name; null is NaN; ``within``: see ``untrusted.open_file``.

    Raises:
        ValueError: it is not a list of name, value, unit, or a name occurs twice.
    """
    try:
        rows = json.loads(read_text(path, within))
        values = [math.nan if row["value"] is None else _number(row["value"]) for row in rows]
        return _unique(
            path.name, ((row["name"], Metric(row["name"], v, row["unit"])) for row, v in zip(rows, values, strict=True))
        )
    except (KeyError, TypeError, RecursionError) as error:
        raise ValueError(f"{path.name} is not a list of name, value, unit") from error


def _number(value: object) -> float:
    """As it stands: a count stays an integer."""
    if not isinstance(value, int | float):
        raise TypeError(f"{value!r} is not a number")
    return value


def _unique(file: str, items: Iterable[tuple[str, _Value]]) -> dict[str, _Value]:
    found: dict[str, _Value] = {}
    for name, value in items:
        if name in found:
            raise ValueError(f"{file}: '{name}' occurs twice")
        found[name] = value
    return found


def _robot_fields(trajectory: RobotTrajectory) -> list[Any]:
    length_m, scans = f"{trajectory.path_length_m:.3f}", len(trajectory.stamps)
    return [trajectory.robot, trajectory.map_index, length_m, scans, trajectory.floor]


def _closure_fields(closure: ClosureRow) -> list[Any]:
    ends = [closure.robot_i, f"{closure.stamp_i:.9f}", closure.robot_j, f"{closure.stamp_j:.9f}"]
    numbers = [f"{number:.6f}" for number in (closure.similarity, *closure.T_i_j)]
    return [*ends, closure.channel.value, *numbers, closure.status.value, *_reason_fields(closure.reason)]


def _reason_fields(reason: Reason) -> list[str]:
    numbers = ["" if number is None else f"{number:.6g}" for number in (reason.value, reason.limit)]
    return [reason.code.value, *numbers, reason.setting]


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
        reason=_read_reason(row),
    )


def _read_reason(row: dict[str, str]) -> Reason:
    value, limit = (float(row[column]) if row[column] else None for column in ("value", "limit"))
    return Reason(ReasonCode(row["reason"]), value, limit, row["setting"])


def _write_csv(path: Path, columns: list[str], rows: Iterable[list[Any]]) -> None:
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(columns)
        writer.writerows(rows)


def _read_csv(path: Path, columns: list[str], within: Path | None = None) -> list[dict[str, str]]:
    reader = csv.DictReader(io.StringIO(read_text(path, within), newline=""))
    rows, heading = list(reader), list(reader.fieldnames or ())
    if not rows and not set(columns) <= set(heading):
        raise ValueError(f"{path.name}, line 1: expected the columns {', '.join(columns)}")
    for number, row in enumerate(rows, start=2):
        if any(row.get(column) is None for column in columns):
            raise ValueError(f"{path.name}, line {number}: expected the columns {', '.join(columns)}")
    return rows
