"""The relations metric: errors of relative poses against manually verified ones.

R. Kuemmerle et al., "On Measuring the Accuracy of SLAM Algorithms", Autonomous Robots 27(4), 2009. A relation is the
pose of the robot (``base``, not the laser) at one stamp relative to its pose at another, so the metric needs no common
coordinate frame and no alignment.
"""

import io
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fcslam.errors import InputError
from fcslam.geometry import se2
from fcslam.records import FloatArray, frozen
from fcslam.untrusted import open_unpacked

STAMP_TOLERANCE_S = 5.5e-6
"""Largest difference of equal stamps: half a unit of the fifth decimal, the last of some files, plus rounding."""

ACROSS_ROBOTS_GAP_S = 20.0
"""Shortest time span of a relation across robots. Shorter ones, across a cut in a log, would measure odometry."""

_COLUMNS = "stamp1 stamp2 x y z roll pitch yaw"


@dataclass(frozen=True, slots=True)
class Relations:
    """Reference relative poses."""

    stamps: FloatArray
    """Shape (N, 2), seconds of the recording's clock."""
    T_1_2: FloatArray
    """Pose of base at the second stamp in base at the first, shape (N, 3)."""

    def __len__(self) -> int:
        return len(self.stamps)

    def where(self, mask: NDArray[np.bool_]) -> "Relations":
        """Relations selected by ``mask``, shape (N,)."""
        return Relations(frozen(self.stamps[mask]), frozen(self.T_1_2[mask]))


@dataclass(frozen=True, slots=True)
class PoseTable:
    """Estimated poses of a fleet, sorted by stamp; stamps are looked up exactly, without interpolation."""

    stamps: FloatArray
    """Shape (M,), ascending, seconds."""
    T_map_base: FloatArray
    """Shape (M, 3), each in the coordinate frame of its own map."""
    robots: NDArray[np.int64]
    """Number of each pose's robot, shape (M,)."""
    maps: NDArray[np.int64]
    """Number of each pose's map, shape (M,)."""

    @classmethod
    def of(
        cls, stamps: ArrayLike, T_map_base: ArrayLike, robots: ArrayLike | None = None, maps: ArrayLike | None = None
    ) -> "PoseTable":
        """Make a table of poses in any order of time (stamps of intel run backwards).

        ``stamps`` (M,) in seconds, poses (M, 3). ``robots`` and ``maps`` are the numbers of each pose's robot and map,
        shape (M,); None: all of one robot, or in one map.
        """
        stamp_column = np.asarray(stamps, dtype=np.float64)
        order = np.argsort(stamp_column, kind="stable")
        zeros = np.zeros(len(stamp_column), dtype=np.int64)
        return cls(
            frozen(stamp_column[order]),
            frozen(np.asarray(T_map_base, dtype=np.float64).reshape(-1, 3)[order]),
            frozen(zeros if robots is None else np.asarray(robots)[order], np.int64),
            frozen(zeros if maps is None else np.asarray(maps)[order], np.int64),
        )

    def find(self, stamps: ArrayLike) -> NDArray[np.int64]:
        """Row of each stamp, same shape; -1 if no pose has the stamp, or if several have it."""
        wanted = np.asarray(stamps, dtype=np.float64)
        if not len(self.stamps):
            return np.full(wanted.shape, -1, dtype=np.int64)
        right = np.clip(np.searchsorted(self.stamps, wanted), 0, len(self.stamps) - 1)
        left = np.maximum(right - 1, 0)
        nearer_left = np.abs(self.stamps[left] - wanted) < np.abs(self.stamps[right] - wanted)
        row = np.where(nearer_left, left, right)
        found = np.abs(self.stamps[row] - wanted) <= STAMP_TOLERANCE_S
        return np.where(found & ~self._ambiguous()[row], row, -1).astype(np.int64)

    def _ambiguous(self) -> NDArray[np.bool_]:
        alike = np.zeros(len(self.stamps) + 1, dtype=np.bool_)
        alike[1:-1] = np.diff(self.stamps) == 0.0
        return np.logical_or(alike[:-1], alike[1:])


@dataclass(frozen=True, slots=True)
class Spread:
    """Statistics of a set of errors; all NaN without errors."""

    mean: float
    std: float
    maximum: float

    @classmethod
    def of(cls, values: FloatArray) -> "Spread":
        """Mean, population standard deviation and maximum of ``values``, shape (K,)."""
        if not len(values):
            return cls(np.nan, np.nan, np.nan)
        return cls(float(np.mean(values)), float(np.std(values)), float(np.max(values)))


@dataclass(frozen=True, slots=True)
class RelationErrors:
    """Errors of the usable relations of a set."""

    translation_m: FloatArray
    """Norm of each translation error, shape (used,)."""
    rotation_deg: FloatArray
    """Absolute rotation error, shape (used,)."""
    total: int
    """Number of selected relations, including unusable ones."""

    @property
    def used(self) -> int:
        """Relations whose two stamps have poses in one map."""
        return len(self.translation_m)

    @property
    def translation(self) -> Spread:
        """Spread of the translational errors, metres."""
        return Spread.of(self.translation_m)

    @property
    def rotation(self) -> Spread:
        """Spread of the rotational errors, degrees."""
        return Spread.of(self.rotation_deg)


def select(
    relations: Relations, poses: PoseTable, minimum_gap_s: float = 0.0, across_robots: bool = False
) -> Relations:
    """Select relations whose stamps are more than ``minimum_gap_s`` apart and, if asked, of different robots.

    A relation with a stamp that ``poses`` does not have is kept, so that it counts as unusable.
    """
    gap_s = np.abs(relations.stamps[:, 1] - relations.stamps[:, 0])
    keep = (gap_s > minimum_gap_s) | (minimum_gap_s <= 0.0)
    if across_robots:
        row = poses.find(relations.stamps)
        robots = poses.robots[row] if len(poses.robots) else row
        keep &= np.any(row < 0, axis=1) | (robots[:, 0] != robots[:, 1])
    return relations.where(keep)


def relation_errors(relations: Relations, poses: PoseTable) -> RelationErrors:
    """Compute the errors of ``poses``; a relation is unusable if a stamp has no pose or its poses are in two maps."""
    row = poses.find(relations.stamps)
    if not np.any(row >= 0):
        raise InputError(
            f"none of the {len(relations)} relations names a stamp of the run; are they of the same recording?"
        )
    usable = np.all(row >= 0, axis=1) & (poses.maps[row[:, 0]] == poses.maps[row[:, 1]])
    first, second = row[usable].T
    estimated = se2.between(poses.T_map_base[first], poses.T_map_base[second])
    return RelationErrors(*motion_errors(relations.T_1_2[usable], estimated), len(relations))


def motion_errors(T_true: FloatArray, T_estimated: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Errors of estimated motions (N, 3), metres and radians, against true ones: metres and degrees, (N,) each."""
    error = se2.between(T_true, T_estimated)
    return frozen(np.hypot(error[:, 0], error[:, 1])), frozen(np.degrees(np.abs(error[:, 2])))


def read_relations(path: Path) -> Relations:
    """Read a relations file, plain, ``.gz`` or ``.xz``."""
    try:
        with open_unpacked(path) as file, io.TextIOWrapper(file, encoding="utf-8") as lines:
            rows = _parse(lines, path)
    except (OSError, EOFError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: cannot read the relations ({error}); name the file of relations") from error
    if not rows:
        raise InputError(f"{path}: no relations in it; expected lines '{_COLUMNS}'")
    table = np.array(rows)
    return Relations(frozen(table[:, :2]), frozen(table[:, [2, 3, 7]]))


def _parse(lines: Iterable[str], path: Path) -> list[list[float]]:
    rows = []
    for number, line in enumerate(lines, start=1):
        fields = line.split()
        if fields and not fields[0].startswith("#"):
            rows.append(_numbers(fields, f"{path}, line {number}"))
    return rows


def _numbers(fields: list[str], where: str) -> list[float]:
    if len(fields) != 8:
        raise InputError(f"{where}: expected 8 numbers '{_COLUMNS}', found {len(fields)} fields")
    try:
        numbers = [float(field) for field in fields]
    except ValueError as error:
        raise InputError(f"{where}: {error}; expected '{_COLUMNS}'") from error
    if not np.all(np.isfinite(numbers)):
        raise InputError(f"{where}: a number that is not finite")
    return numbers
