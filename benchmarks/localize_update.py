"""A map that follows the building: a robot localizes in the map of the day before, and draws what moved since.

    python benchmarks/localize_update.py [--seeds 10] [--path 120]

On the first day, a simulated robot (LiDAR, 360 beams at 5 Hz) maps a building. Then 30 % of the furniture moves in the
rooms that a second robot visits. On the second day, that robot localizes in the map with `fcslam localize --update`.
On the third day the building is as the second robot found it: F1 of the surfaces (0.10 m) of the map against this
building, before and after the update. Moved: the same of surfaces farther than 0.15 m from those of the other day; the
share of new ones that the map has, and the share of old ones that it still has.
"""

import common
import numpy as np
from certificate import Simulated
from lifelong import building_now, segment_points, within
from worlds.changing import ChangingBuilding

from fcslam.geometry import se2
from fcslam.lab.evaluation.ground_truth import labelled
from fcslam.lab.simulation.noise import LidarSettings
from fcslam.lab.simulation.simulated_fleet import SimulationSettings, simulate_fleet
from fcslam.maps.occupancy_map import parse_map
from fcslam.metrics.grid import grid_agreement
from fcslam.metrics.trajectory import align
from fcslam.mission.localization import FinishedMap, run_localization
from fcslam.mission.mission import MissionConfig, run_mission

MOVED_M = 0.15


def main() -> None:
    parser = common.options(__doc__ or "")
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--path", type=float, default=120.0, help="of each robot, m")
    chosen = parser.parse_args()
    report = common.Report(__file__, __doc__ or "", chosen)
    rows = [(f"building {seed}", *_judged(seed, chosen.path)) for seed in range(chosen.seeds)]
    rows.append(("mean", *np.nanmean([row[1:] for row in rows], axis=0)))
    report.table(
        "Maps",
        {"": "s", "F1 before": ".3f", "F1 after": ".3f", "new surfaces drawn, %": ".1f", "old ones left, %": ".1f",
         "localized, %": ".1f"},
        rows,
    )  # fmt: skip
    report.write()


def _judged(seed, path_m):
    settings = SimulationSettings(
        robots=2, path_length_m=path_m, camera=None, lidar=LidarSettings(rate_hz=5.0), moved_furniture=0.3
    )  # fmt: skip
    first, second = simulate_fleet(settings, seed, ChangingBuilding(settings.building)).robots
    mapped = run_mission([Simulated(first)], MissionConfig())
    followed = run_localization(Simulated(second), FinishedMap(mapped.maps[0]), MissionConfig(), update=True)
    path = mapped.trajectories[first.name]
    T_truth_map = align(first.T_building_base[np.searchsorted(first.stamps, path.stamps - 1e-6)], path.T_map_base)
    truth = labelled(building_now([first, second]))
    maps = [
        labelled(parse_map(name, followed.map_files[f"{name}.pgm"], followed.map_files[f"{name}.yaml"].decode()))
        for name in ("map_before", "map")
    ]
    seen = truth.centres(truth.occupied)
    drawn = se2.transform(T_truth_map, maps[1].centres(maps[1].occupied))
    old, new = (segment_points(robot.plan) for robot in (first, second))
    appeared = seen[~within(seen, old, MOVED_M)]
    gone = old[~within(old, new, MOVED_M)]
    before = se2.transform(T_truth_map, maps[0].centres(maps[0].occupied))
    gone = gone[within(gone, before, 0.1)]
    f1 = [grid_agreement(grid, truth, T_truth_map).f1 for grid in maps]
    localized = followed.localized[second.name].is_localized.mean()
    return *f1, 100.0 * _share(appeared, drawn), 100.0 * _share(gone, drawn), 100.0 * localized


def _share(points, drawn):
    return within(points, drawn, 0.1).mean() if len(points) else np.nan


if __name__ == "__main__":
    main()
