"""Drives of robots in published floors, by a simulator that is not part of the project. No benchmark itself.

The simulator is `tools/floor_world.py` beside the folder of recordings. It puts robots with spinning scanners, walkers,
slipping wheels, lost and mixed beams into an occupancy grid (`floors/NAME.npz` in the folder of recordings), and writes
ROS 2 bags and true poses.
"""

import json
import os
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import common
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from fcslam.metrics.trajectory import PositionErrors, align, interpolate, position_errors
from fcslam.records import FloatArray
from fcslam.runs.tables import read_tum

CELL_M = 0.05
"""Side of a cell of a floor."""
FLOORS = (
    "aws_hospital", "depot", "eng2_7f_2015_02", "eng2_7f_2018_01", "eng2_7f_2021_03", "eng6_1f", "eng6_2f", "eng6_3f",
    "g4s", "gdc1", "gdc2", "kth", "stata", "torino",
)  # fmt: skip


class Floor:
    """Masks of the free and of the occupied cells of a floor, row 0 = least y."""

    def __init__(self, free: NDArray[np.bool_], occupied: NDArray[np.bool_]) -> None:
        self.free, self.occupied = free, occupied

    @classmethod
    def read(cls, name: str) -> "Floor":
        with np.load(common.recordings(f"{name}.npz", kind="floors") / f"{name}.npz") as arrays:
            return cls(arrays["free"], arrays["occ"])

    def write(self, path: Path) -> None:
        np.savez_compressed(path, free=self.free, occ=self.occupied)


def mirrored(floor: Floor) -> Floor:
    """The floor seen in a mirror."""
    return Floor(floor.free[:, ::-1], floor.occupied[:, ::-1])


def shifted(floor: Floor, shift_m: float = 1.5) -> Floor:
    """The floor whose rooms beyond the middle of its longer side lie farther along the other side."""
    cells = round(shift_m / CELL_M)
    axis = 0 if floor.free.shape[0] > floor.free.shape[1] else 1

    def of(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
        first, second = np.array_split(np.pad(mask, cells), 2, axis=axis)
        return np.concatenate((first, np.roll(second, cells, axis=1 - axis)), axis=axis)

    return Floor(of(floor.free), of(floor.occupied))


def refurnished(floor: Floor, seed: int, share: float = 0.25) -> Floor:
    """The floor with boxes of 0.4 to 1.6 m in new places, and without most of its small things."""
    rng = np.random.default_rng(seed)
    solid = ~floor.free
    labels, count = ndimage.label(floor.occupied, np.ones((3, 3)))
    sizes = ndimage.sum(floor.occupied, labels, np.arange(count + 1))
    gone = np.isin(labels, np.flatnonzero((sizes < 120) & (rng.random(count + 1) < 0.7) & (np.arange(count + 1) > 0)))
    around = ndimage.binary_dilation(gone, iterations=2) & ~(floor.occupied & ~gone)
    free, occupied = floor.free | (around & ndimage.binary_dilation(floor.free, iterations=8)), floor.occupied & ~gone
    target, placed = share * 0.12 * np.count_nonzero(floor.free), 0
    distance_m = ndimage.distance_transform_edt(~solid) * CELL_M
    near_walls = np.argwhere((distance_m > 0.2) & (distance_m < 1.2))
    while placed < target:
        row, column = near_walls[rng.integers(len(near_walls))]
        height, width = (int(side / CELL_M) for side in rng.uniform(0.4, 1.6, 2))
        box = np.s_[max(0, row - height // 2) : row + height // 2, max(0, column - width // 2) : column + width // 2]
        inside = free[box].copy()
        # A passage stays open: nothing stands farther than 1.6 m from a wall or in a door.
        if inside.mean() < 0.6 or distance_m[box].max() > 1.6:
            continue
        occupied[box] |= inside
        free[box] &= ~inside
        placed += int(np.count_nonzero(inside))
    return Floor(free, occupied)


def drive(world: str, folder: Path, *options: object, floors: Path | None = None) -> dict[str, Any]:
    """Drives in a floor, unless they are in ``folder`` already; returns what the simulator says about them.

    Args:
        world: name of a floor.
        folder: gets a bag ``NAME`` and true poses ``NAME.truth.tum`` of each robot.
        options: further options of the simulator, such as ``"--seed", 3``.
        floors: folder with further floors.
    """
    if not (folder / "info.json").exists():
        simulator = common.recordings(kind="floors").parents[1] / "tools" / "floor_world.py"
        if not simulator.exists():
            sys.exit(f"{simulator} is missing: the simulator of published floors")
        environment = os.environ | ({} if floors is None else {"FLOORS": str(floors)})
        command = [sys.executable, str(simulator), world, str(folder), *map(str, options)]
        subprocess.run(command, env=environment, check=True, stdout=subprocess.DEVNULL)
    found: dict[str, Any] = json.loads((folder / "info.json").read_text(encoding="utf-8"))
    return found


def joint_errors(folder: Path, run: Path, sessions: Sequence[str]) -> PositionErrors:
    """Position errors of all scans of several sessions in one map, after one rigid alignment."""
    pairs = [true_and_found(folder, run, session) for session in sessions]
    true, found = (np.concatenate(poses) for poses in zip(*pairs, strict=True))
    return PositionErrors.of(position_errors(align(true, found), true, found))


def true_and_found(folder: Path, run: Path, session: str) -> tuple[FloatArray, FloatArray]:
    """Poses of a session at the same stamps, shape (N, 3)."""
    stamps, poses = read_tum(run / "trajectories" / f"{session}.tum")
    truth = interpolate(*read_tum(folder / f"{session.partition('+')[0]}.truth.tum"), stamps, gap_s=0.5)
    known = np.isfinite(truth[:, 0])
    return truth[known], poses[known]


def maps_of(run: Path) -> Mapping[str, int]:
    """Number of the map of each session of a run."""
    lines = (run / "robots.csv").read_text(encoding="utf-8").splitlines()
    names = lines[0].split(",")
    rows = [dict(zip(names, line.split(","), strict=False)) for line in lines[1:]]
    return {row["robot"]: int(row["map"]) for row in rows}
