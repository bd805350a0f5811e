"""Localization in a finished 3D map: how exact are robots with 3D and 2D LiDARs in six degrees of freedom?

    python benchmarks/three_d_localize.py /path/to/bags
    python benchmarks/three_d_localize.py /path/to/bags --seeds 93

Bags are of the simulator of `three_d.py`: `s<seed>a` and `s<seed>b` make the map. Slower drives of other noise through
a part of the building, `c<seed>` with a 3D LiDAR and `l<seed>` with a 2D one below the ramp, are localized in it
without an initial pose. Errors are those in the frame of the map, whose place in the building is the rigid alignment of
both robots that made it; so errors of the map count. Strangers are localized in the map of the next seed.
"""

from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import NamedTuple

import common
import numpy as np
from three_d import SPACE

import fcslam
from fcslam.geometry import se3
from fcslam.mission.localization import FinishedMap
from fcslam.runs import RobotTrajectory
from fcslam.runs.tables import read_tum_6d

COLUMNS = {"seed": "", "LiDAR": "", "first fix, m": ".1f", "localized": ".0%", "losses": "", "ATE (RMSE), m": ".4f",
           "z (RMSE), m": ".4f", "max, m": ".3f", "rotation, deg": ".3f", "map (RMSE), m": ".4f"}  # fmt: skip
LIDARS = {"3D": "c", "2D": "l"}


class Mapped(NamedTuple):
    """A map, the pose of the building in it (7,), and its error."""

    finished: FinishedMap
    T_map_building: np.ndarray
    error_m: float


def main() -> None:
    parser = common.options(__doc__)
    parser.add_argument("bags", type=Path, help="folder of the bags")
    parser.add_argument("--seeds", nargs="*", type=int, default=(91, 93, 94, 95))
    parser.add_argument("--processes", type=int, default=2, help="seeds at a time")
    chosen = parser.parse_args()
    folders = [chosen.bags] * len(chosen.seeds)
    with ProcessPoolExecutor(chosen.processes) as pool:
        maps = list(pool.map(mapped, folders, chosen.seeds))
        drives = [(chosen.bags, *each, lidar) for each in zip(chosen.seeds, maps, strict=True) for lidar in LIDARS]
        rows = list(pool.map(row_of, *zip(*drives, strict=True)))
        others = zip(chosen.seeds, maps[1:] + maps[:1], strict=True)
        away = [(chosen.bags, *each, lidar) for each in others for lidar in LIDARS] if len(maps) > 1 else []
        found = [run.metrics["fixes"].value for run in pool.map(localized, *zip(*away, strict=True))] if away else []
    report = common.Report(__file__, __doc__, chosen)
    report.table("Drives in the map of their building", COLUMNS, rows)
    report.say(f"Of {len(found)} strangers, {sum(map(bool, found))} got a pose.")
    report.write()


def mapped(bags: Path, seed: int) -> Mapped:
    recordings = {name: bags / f"s{seed}{part}" for name, part in (("anna", "a"), ("ben", "b"))}
    run = fcslam.map_recordings(recordings, config=SPACE)
    sides = [against(bags, path.name, run.trajectories[name]) for name, path in recordings.items()]
    found, true = (np.concatenate(side) for side in zip(*sides, strict=True))
    centres = found[:, :3].mean(axis=0), true[:, :3].mean(axis=0)
    spread = (found[:, :3] - centres[0]).T @ (true[:, :3] - centres[1])
    u, _, v = np.linalg.svd(spread + np.einsum("nij,nkj->ik", se3.rotation(found), se3.rotation(true)))
    matrix = np.eye(4)
    matrix[:3, :3] = u @ np.diag((1.0, 1.0, np.linalg.det(u @ v))) @ v
    matrix[:3, 3] = centres[0] - matrix[:3, :3] @ centres[1]
    T_map_building = se3.from_matrix(matrix)
    error = np.linalg.norm(se3.compose(T_map_building, true)[:, :3] - found[:, :3], axis=1)
    return Mapped(FinishedMap(run.maps[0], run.map_files["map.ply"]), T_map_building, rms(error))


def against(bags: Path, bag: str, trajectory: RobotTrajectory) -> tuple[np.ndarray, np.ndarray]:
    """Poses of a trajectory, and the true ones."""
    stamps, true = read_tum_6d(bags / f"{bag}.truth.tum")
    return trajectory.poses, true[np.abs(stamps[:, None] - trajectory.stamps).argmin(axis=0)]


def localized(bags: Path, seed: int, mapped: Mapped, lidar: str) -> fcslam.Run:
    return fcslam.localize(bags / f"{LIDARS[lidar]}{seed}", mapped.finished)


def row_of(bags: Path, seed: int, mapped: Mapped, lidar: str) -> tuple:
    run = localized(bags, seed, mapped, lidar)
    values = {name: metric.value for name, metric in run.metrics.items()}
    (trajectory,) = run.trajectories.values()
    found, true = against(bags, f"{LIDARS[lidar]}{seed}", trajectory)
    off = se3.between(se3.compose(mapped.T_map_building, true), found)
    height = (se3.compose(se3.inverse(mapped.T_map_building), found) - true)[:, 2]
    error = np.linalg.norm(off[:, :3], axis=1)
    angle = np.degrees(2.0 * np.arccos(np.abs(off[:, 6]).clip(max=1.0))).mean()
    share, losses = values["localized_share"], int(values["losses"])
    return (
        seed,
        lidar,
        values["first_fix_after"],
        share,
        losses,
        rms(error),
        rms(height),
        error.max(),
        angle,
        mapped.error_m,
    )


def rms(values: np.ndarray) -> float:
    return float(np.sqrt((values**2).mean()))


if __name__ == "__main__":
    main()
