"""The certificate of maps against the truth, in published floors and in simulated buildings.

    FCSLAM_DATA=/path/to/data python benchmarks/real_floors.py --work build/floors
    python benchmarks/certificate.py --work build/floors [--seeds 8] [--path 60]

The error of a cell of 1 m2: the root mean square distance of the positions of keyscans within 10 m from the true ones,
after the best rigid alignment of both, at the nearest keyscan. A cell is good if the error is at most 5 cm, a cell of
the map. "called": by its bound.

Floors: the maps of `real_floors.py`, each of one robot or of two that were on one floor. Buildings: two robots with a
good scanner (12 m far, noise of 0.015 m) or a short one (4 m, 0.04 m), one with a medium (5 m, 0.03 m) or a weak one
(3 m, 0.06 m). Maps of the short and the weak scanner are bad nearly everywhere.

Leaving out: for each building, `QUANTILE` is chosen by the maps of all other buildings. "Conformal" is the quantile of
95 % of the ratio between the 95 % error of a map and its expected one. Held: maps of the building whose 95 % error is
below the bound. "Balanced" is the factor at which the worse of two shares is best: good cells called good, over 95 %,
and bad cells called bad, over 80 %. Three years of one floor, or the floors of one building, are one building.
"""

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import common
import numpy as np
from scipy.spatial import cKDTree

from fcslam.lab.simulation.noise import LidarSettings
from fcslam.lab.simulation.simulated_fleet import SimulationSettings, simulate_fleet
from fcslam.maps.certificate import CELL_M, QUANTILE, WITHIN_M
from fcslam.metrics.trajectory import align, interpolate, position_errors
from fcslam.mission.mission import MissionConfig, run_mission
from fcslam.records import FloatArray
from fcslam.runs import Run, open_run
from fcslam.runs.tables import read_tum
from fcslam.sources.faults import Faults
from fcslam.sources.source import Survey

BAR_M = 0.05
DIFFERENT = "other", "mirrored", "shifted", "refurnished"
"""Kinds of runs of two floors."""
SCANNERS = (
    ("good scanner", 2, LidarSettings(beams=180, rate_hz=3.0)),
    ("medium scanner", 1, LidarSettings(beams=180, rate_hz=3.0, max_range_m=5.0, range_noise_m=0.03)),
    ("short scanner", 2, LidarSettings(beams=180, rate_hz=3.0, max_range_m=4.0, range_noise_m=0.04)),
    ("weak scanner", 1, LidarSettings(beams=180, rate_hz=3.0, max_range_m=3.0, range_noise_m=0.06)),
)
COLUMNS = {"": "", "maps": ",d", "good cells": ",d", "called good, %": ".1f", "bad cells": ",d",
           "called bad, %": ".1f", "of those called good, good, %": ".1f", "within the bound, %": ".1f"}  # fmt: skip
LEFT_OUT = {"building": "", "maps": ",d", "conformal": ".2f", "maps held, %": ".0f", "good, %": ".1f",
            "bad, %": ".1f", "balanced": ".2f", "good called good, %": ".1f", "bad called bad, %": ".1f"}  # fmt: skip


class Simulated:
    """A simulated robot as a recording."""

    faults = Faults({})

    def __init__(self, robot):
        self._robot, self.name = robot, robot.name

    def survey(self):
        robot = self._robot
        return Survey(len(robot.stamps), robot.duration_s, 0.0, robot.lasers, self.faults)

    def records(self):
        return self._robot.scans()


class JudgedMap(NamedTuple):
    """The cells of one map."""

    building: str
    group: str
    """Of which table it is a line."""
    bound_m: FloatArray
    error_m: FloatArray

    @property
    def ratio(self) -> float:
        """The 95 % error, divided by the expected one."""
        return float(QUANTILE * np.percentile(self.error_m, 95) / np.percentile(self.bound_m, 95))


def main() -> None:
    parser = common.options(__doc__)
    parser.add_argument("--seeds", type=int, default=8)
    parser.add_argument("--path", type=float, default=60.0, help="of each robot in a simulated building, m")
    parser.add_argument("--work", type=Path, default=common.REPOSITORY / "build" / "floors", help="as of real_floors")
    chosen = parser.parse_args()
    report = common.Report(__file__, __doc__, chosen)
    floors = [one for folder in sorted((chosen.work / "runs").iterdir()) for one in of_floor(folder)]
    built = [one for title, robots, lidar in SCANNERS for seed in range(chosen.seeds)
             for one in of_building(title, robots, lidar, seed, chosen.path)]  # fmt: skip
    report.table("Cells of published floors", COLUMNS, rows(floors, "all floors"))
    report.table("Cells of simulated buildings", COLUMNS, rows(built, "all buildings"))
    report.table("Cells of all maps", COLUMNS, [row("all", floors + built)])
    report.table("Each building left out", LEFT_OUT, left_out(floors + built))
    report.write()


def of_floor(folder: Path) -> Iterator[JudgedMap]:
    """The maps of a run of ``real_floors.py`` whose robots were on one floor."""
    kind = folder.name.split("-")[0]
    if not (folder / "truth").exists() or kind not in ("pair", "year", *DIFFERENT):
        return
    run = open_run(folder / "run", maps=False)
    truths = {path.name.removesuffix(".truth.tum"): read_tum(path) for path in (folder / "truth").iterdir()}
    floor = re.sub(r"^(pair|year|mirrored|shifted|refurnished|other-floor)-", "", folder.name)
    building = re.match(r"eng\d|gdc|[a-z0-9_]+", floor)
    name = floor if building is None else building[0]
    for k, members in members_of(run).items():
        if len(members) == 1 or kind not in DIFFERENT:
            poses = [run.trajectories[session].T_map_base for session in members]
            true = [interpolate(*truths[session.split("+")[0]], run.trajectories[session].stamps, 0.5)
                    for session in members]  # fmt: skip
            yield from judged(run, k, name, name, np.concatenate(poses), np.concatenate(true))


def of_building(title: str, robots: int, lidar: LidarSettings, seed: int, path_m: float) -> Iterator[JudgedMap]:
    """The maps of a simulated building."""
    settings = SimulationSettings(robots=robots, path_length_m=path_m, lidar=lidar, camera=None)
    fleet = {robot.name: robot for robot in simulate_fleet(settings, seed).robots}
    run = run_mission([Simulated(robot) for robot in fleet.values()], MissionConfig())
    for k, members in members_of(run).items():
        mapped = [(fleet[session.split("+")[0]], run.trajectories[session]) for session in members]
        true = [robot.T_building_base[np.searchsorted(robot.stamps, its.stamps - 1e-6)] for robot, its in mapped]
        poses = np.concatenate([its.T_map_base for _, its in mapped])
        yield from judged(run, k, f"simulated {seed}", title, poses, np.concatenate(true))


def members_of(run: Run) -> dict[int, list[str]]:
    found: dict[int, list[str]] = {}
    for session in run.trajectories.values():
        found.setdefault(session.map_index, []).append(session.robot)
    return found


def judged(run: Run, k: int, building: str, group: str, estimate: FloatArray, truth: FloatArray) -> Iterator[JudgedMap]:
    """Bounds and true errors of the cells of one map, given estimated and true poses (N, 3) of its robots."""
    certificate = json.loads(run.quality or b"{}").get(str(k))
    if certificate is None or not certificate["cells"]:
        return
    places, error_m = bends(estimate, truth)
    if len(places) < 10:
        return
    centres = np.array([(cell["x"], cell["y"]) for cell in certificate["cells"]])
    bound_m = np.array([cell["bound_95"] for cell in certificate["cells"]])
    yield JudgedMap(building, group, bound_m, error_m[cKDTree(places).query(centres)[1]])


def bends(estimate: FloatArray, truth: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Places about 1 m apart, shape (P, 2), and the errors of the map around them, shape (P,), by poses (N, 3)."""
    known = np.isfinite(truth[:, 0])
    estimate, truth = estimate[known], truth[known]
    kept = np.unique(np.floor(estimate[:, :2] / CELL_M).astype(np.int64), axis=0, return_index=True)[1]
    estimate, truth = estimate[kept], truth[kept]
    error_m = np.zeros(len(kept))
    for row, near in enumerate(cKDTree(estimate[:, :2]).query_ball_point(estimate[:, :2], WITHIN_M)):
        if len(near) > 2:
            T = align(truth[near], estimate[near])
            error_m[row] = np.sqrt((position_errors(T, truth[near], estimate[near]) ** 2).mean())
    return estimate[:, :2], error_m


def row(title: str, maps: list[JudgedMap], factor: float = 1.0) -> tuple:
    bound_m, error_m = (np.concatenate([one[k] for one in maps]) for k in (2, 3))
    good, called = error_m <= BAR_M, factor * bound_m <= BAR_M
    return (title, len(maps), int(good.sum()), percent(called[good]), int((~good).sum()), percent(~called[~good]),
            percent(good[called]), percent(error_m <= factor * bound_m))  # fmt: skip


def rows(maps: list[JudgedMap], title: str) -> list[tuple]:
    groups = dict.fromkeys(one.group for one in maps)
    return [*(row(group, [one for one in maps if one.group == group]) for group in groups), row(title, maps)]


def left_out(maps: list[JudgedMap]) -> Iterator[tuple]:
    held, rescaled = [], ([], [])
    for building in dict.fromkeys(one.building for one in maps):
        mine, others = ([one for one in maps if (one.building == building) == inside] for inside in (True, False))
        ratios = np.sort([one.ratio for one in others])
        conformal = float(ratios[min(len(ratios), int(np.ceil(0.95 * (len(ratios) + 1)))) - 1]) / QUANTILE
        factors = conformal, max(np.arange(0.2, 3.0, 0.02), key=lambda factor: balance(others, factor))
        held += [one.ratio <= QUANTILE * conformal for one in mine]
        for every, factor in zip(rescaled, factors, strict=True):
            every += [one._replace(bound_m=factor * one.bound_m) for one in mine]
        shares = [row("", mine, factor)[3:6:2] for factor in factors]
        yield (building, len(mine), QUANTILE * factors[0], 100.0 * float(np.mean(held[-len(mine) :])), *shares[0],
               QUANTILE * factors[1], *shares[1])  # fmt: skip
    shares = [row("", every)[3:6:2] for every in rescaled]
    yield "all", len(maps), float("nan"), 100.0 * float(np.mean(held)), *shares[0], float("nan"), *shares[1]


def balance(maps: list[JudgedMap], factor: float) -> float:
    """The worse of two shares: good cells called good beyond 95 %, bad ones called bad beyond 80 %."""
    good, bad = row("", maps, factor)[3:6:2]
    return float(np.nanmin([(good - 95.0) / 5.0, (bad - 80.0) / 20.0]))


def percent(values: FloatArray) -> float:
    return 100.0 * float(np.mean(values)) if len(values) else float("nan")


if __name__ == "__main__":
    main()
