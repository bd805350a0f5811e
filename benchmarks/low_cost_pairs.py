"""Two robots with low-cost scanners in one building: do their maps join, and never falsely?

    python benchmarks/low_cost_pairs.py

Two simulated robots start anywhere in one building of each seed and drive 40 m each. The scanner has 450 beams, 12 m
and 2 cm noise at 7 Hz; its beams are measured at once, or one after the other while the robot moves. Joined: one map,
and the error of both paths together after one rigid alignment is below 0.5 m.
"""

import math

import common
import numpy as np
from robustness import Recording

from fcslam.geometry import se2
from fcslam.lab.simulation.noise import LidarSettings
from fcslam.lab.simulation.simulated_fleet import SimulationSettings, simulate_fleet
from fcslam.metrics.trajectory import align
from fcslam.mission.mission import MissionConfig, run_mission

JOINED_M = 0.5
SPINS = {"at once": 0, "one after the other": -1}
COLUMNS = {"beams": "", "seed": "", "maps": ".0f", "closures": ".0f", "ATE in one map, m": ".3f", "outcome": ""}
COUNTS = {"beams": "", "pairs": "", "joined": "", "apart": "", "falsely joined": ""}


def main() -> None:
    parser = common.options(__doc__)
    parser.add_argument("--seeds", type=int, default=10, help="number of the buildings")
    chosen = parser.parse_args()
    report = common.Report(__file__, __doc__, chosen)
    rows = [pair(beams, seed) for beams in SPINS for seed in range(chosen.seeds)]
    outcomes = {beams: [row[-1] for row in rows if row[0] == beams] for beams in SPINS}
    counts = [(beams, len(all_), *map(all_.count, list(COUNTS)[2:])) for beams, all_ in outcomes.items()]
    report.table("Outcomes", COUNTS, counts)
    report.table("Pairs", COLUMNS, rows)
    report.write()


def pair(beams: str, seed: int) -> tuple:
    lidar = LidarSettings(beams=450, rate_hz=7.0, range_noise_m=0.02, spin=SPINS[beams])
    fleet = simulate_fleet(SimulationSettings(robots=2, path_length_m=40.0, camera=None, lidar=lidar), seed)
    run = run_mission([Recording(robot.name, list(robot.scans())) for robot in fleet.robots], MissionConfig())
    maps, closures = (run.metrics[name].value for name in ("maps", "inter_robot_closures_accepted"))
    error_m = math.nan
    if maps == 1:
        found = np.vstack([run.trajectories[robot.name].T_map_base for robot in fleet.robots])
        truth = np.vstack([robot.T_building_base for robot in fleet.robots])
        off = se2.compose(align(truth, found), found) - truth
        error_m = float(np.sqrt(np.mean(np.sum(off[:, :2] ** 2, axis=1))))
    outcome = "apart" if maps > 1 else "joined" if error_m < JOINED_M else "falsely joined"
    return beams, seed, maps, closures, error_m, outcome


if __name__ == "__main__":
    main()
