"""The certificate of maps against the truth, on simulated buildings that were never used for its calibration.

    python benchmarks/certificate.py [--seeds 10] [--first 100] [--robots 2] [--path 60]

Two robots drive through each building; it is mapped with the default configuration. A cell of 1 m2 is good to 5 cm if
the positions within 10 m, as seen from the nearest keyscan, have a smaller root mean square error. `SCALE` and
`QUANTILE` of `fcslam.maps.certificate` were chosen on the seeds 0 to 5 (`--first 0 --seeds 6`). Fit: the ratio of true
to expected errors, median and 95 %.
"""

import json

import common
import numpy as np

from fcslam.lab.evaluation.fleet.quality import judge
from fcslam.lab.simulation.noise import LidarSettings
from fcslam.lab.simulation.simulated_fleet import SimulationSettings, simulate_fleet
from fcslam.maps.certificate import QUANTILE
from fcslam.mission.mission import MissionConfig, run_mission
from fcslam.sources.faults import Faults
from fcslam.sources.source import WHOLE, Survey


class Simulated:
    """A simulated robot as a recording."""

    faults = Faults({})

    def __init__(self, robot):
        self._robot, self.name = robot, robot.name

    def survey(self, _scans=WHOLE):
        robot = self._robot
        return Survey(len(robot.stamps), robot.duration_s, 0.0, robot.lasers, self.faults)

    def records(self, _scans=WHOLE):
        return self._robot.scans()


def main() -> None:
    parser = common.options(__doc__ or "")
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--first", type=int, default=100)
    parser.add_argument("--robots", type=int, default=2)
    parser.add_argument("--path", type=float, default=60.0, help="of each robot, m")
    chosen = parser.parse_args()
    report = common.Report(__file__, __doc__ or "", chosen)
    rows, all_bound, all_error = [], [], []
    for seed in range(chosen.first, chosen.first + chosen.seeds):
        settings = SimulationSettings(
            robots=chosen.robots, path_length_m=chosen.path, lidar=LidarSettings(beams=180, rate_hz=3.0), camera=None
        )
        robots = simulate_fleet(settings, seed).robots
        run = run_mission([Simulated(robot) for robot in robots], MissionConfig())
        bound, error = [], []
        for k, certificate in json.loads(run.quality["quality.json"]).items():
            members = [robot for robot in robots if run.trajectories[robot.name].map_index == int(k)]
            estimate = np.concatenate([run.trajectories[robot.name].T_map_base for robot in members])
            truth = np.concatenate([
                robot.T_building_base[np.searchsorted(robot.stamps, run.trajectories[robot.name].stamps - 1e-6)]
                for robot in members
            ])  # fmt: skip
            judged = judge(certificate, estimate, truth)
            bound.append(judged.bound_m)
            error.append(judged.error_m)
        all_bound.append(np.concatenate(bound))
        all_error.append(np.concatenate(error))
        rows.append((f"building {seed}", *_shares(all_bound[-1], all_error[-1])))
    rows.append(("all", *_shares(np.concatenate(all_bound), np.concatenate(all_error))))
    report.table(
        "Cells",
        {"": "s", "cells": ",d", "said good": ",d", "right, %": ".1f", "worse than 5 cm": ",d", "flagged, %": ".1f",
         "fit 50 %": ".2f", "fit 95 %": ".2f"},
        rows,
    )  # fmt: skip
    report.write()


def _shares(bound, error, bar_m=0.05):
    said, worse = bound <= bar_m, error > bar_m
    right = 100.0 * (~worse)[said].mean() if said.any() else np.nan
    flagged = 100.0 * (~said)[worse].mean() if worse.any() else np.nan
    return (len(bound), int(said.sum()), right, int(worse.sum()), flagged,
            *np.percentile(error / (bound / QUANTILE), (50, 95)))  # fmt: skip


if __name__ == "__main__":
    main()
