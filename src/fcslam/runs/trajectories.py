"""Trajectories as TUM files."""

from pathlib import Path
from typing import BinaryIO

import numpy as np

from fcslam.errors import EvaluationError
from fcslam.records import FloatArray, frozen
from fcslam.untrusted import read_text

_TUM_LINE = "%.9f %.9f %.9f 0 0 0 %.9f %.9f\n"


def write_tum(path: Path | BinaryIO, stamps: FloatArray, T_map_base: FloatArray) -> None:
    """Write poses (N, 3) as TUM lines ``stamp x y 0 0 0 qz qw``, nine digits after the point."""
    half = T_map_base[:, 2] / 2.0
    rows = np.column_stack((stamps, T_map_base[:, :2], np.sin(half), np.cos(half)))
    text = "".join(_TUM_LINE % tuple(row) for row in rows.tolist()).encode()
    if isinstance(path, Path):
        path.write_bytes(text)
    else:
        path.write(text)


def read_tum(path: Path, within: Path | None = None) -> tuple[FloatArray, FloatArray]:
    """Stamps (N,) and poses (N, 3) of a TUM file, in its order; ``within``: see ``untrusted.open_file``.

    Raises:
        EvaluationError: the file cannot be read or a line is not eight finite numbers.
    """
    try:
        rows = [_tum_fields(line) for line in read_text(path, within).splitlines() if line.strip()]
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
