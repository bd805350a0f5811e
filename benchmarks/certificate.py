"""The certificate of maps against the truth, on simulated buildings and logs that were never used for its calibration.

    FCSLAM_DATA=/path/to/data python benchmarks/certificate.py [--seeds 10] [--first 100] [--robots 2] [--path 60]

Two robots drive through each building; it is mapped with the default configuration. A cell of 1 m2 is good to 5 cm if
the positions within 10 m, as seen from the nearest keyscan, have a smaller root mean square error. `SCALE` and
`QUANTILE` of `fcslam.maps.certificate` were chosen on the seeds 0 to 5 (`--first 0 --seeds 6`), `CONTRADICTED` on weak
scanners in other kinds of buildings, with drives in the buildings 100 and 101, too. Fit: the ratio of true to expected
errors, median and 95 %.

The good scanner sees 12 m far, with noise of 0.015 m. The weak one sees 3 m far, with noise of 0.06 m, on one
robot: its maps are worse than 5 cm. Logs: the error of a cell is the root mean square error of the pairs of scans up to
10 m apart that end in it and whose relation is known. The relations have errors of a few centimetres, too.
"""

import json
import os

import common
import numpy as np
from scipy.spatial import cKDTree

import fcslam
from fcslam.geometry import se2
from fcslam.lab.evaluation.fleet.quality import judge
from fcslam.lab.evaluation.fleet.relations import pose_table
from fcslam.lab.simulation.noise import LidarSettings
from fcslam.lab.simulation.simulated_fleet import SimulationSettings, simulate_fleet
from fcslam.maps.certificate import QUANTILE
from fcslam.metrics.relations import motion_errors, read_relations
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
    for title, robots, lidar in (
        ("good scanner", chosen.robots, LidarSettings(beams=180, rate_hz=3.0)),
        ("weak scanner", 1, LidarSettings(beams=180, rate_hz=3.0, max_range_m=3.0, range_noise_m=0.06)),
    ):
        settings = SimulationSettings(robots=robots, path_length_m=chosen.path, lidar=lidar, camera=None)
        parts = [(f"building {seed}", *_simulated(settings, seed))
                 for seed in range(chosen.first, chosen.first + chosen.seeds)]  # fmt: skip
        _table(report, f"Cells, {title}", parts)
    if "FCSLAM_DATA" in os.environ:
        folder = common.recordings(*common.slam_benchmark_files())
        _table(report, "Cells of the logs", [(name, *_log(folder, name)) for name in common.SPLITS])
    report.write()


def _table(report, title, parts):
    rows = [(name, *_shares(bound, error)) for name, bound, error in parts]
    rows.append(("all", *_shares(*(np.concatenate([part[k] for part in parts]) for k in (1, 2)))))
    report.table(
        title,
        {"": "s", "number": ",d", "said good": ",d", "right, %": ".1f", "worse than 5 cm": ",d", "flagged, %": ".1f",
         "fit 50 %": ".2f", "fit 95 %": ".2f"},
        rows,
    )  # fmt: skip


def _simulated(settings, seed):
    """Bounds and true errors of the cells of a simulated building."""
    robots = simulate_fleet(settings, seed).robots
    run = run_mission([Simulated(robot) for robot in robots], MissionConfig())
    found = []
    for k, certificate in json.loads(run.quality["quality.json"]).items():
        members = [robot for robot in robots if run.trajectories[robot.name].map_index == int(k)]
        estimate = np.concatenate([run.trajectories[robot.name].T_map_base for robot in members])
        truth = np.concatenate([
            robot.T_building_base[np.searchsorted(robot.stamps, run.trajectories[robot.name].stamps - 1e-6)]
            for robot in members
        ])  # fmt: skip
        judged = judge(certificate, estimate, truth)
        found.append((judged.bound_m, judged.error_m))
    return tuple(np.concatenate(part) for part in zip(*found, strict=True))


def _log(folder, name):
    """Bounds and errors of the cells in which pairs of scans end whose relation is known."""
    run = fcslam.map_recordings(common.log_path(folder, name))
    certificate = json.loads(run.quality["quality.json"])["0"]
    relations, poses = read_relations(common.relations_path(folder, name)), pose_table(run)
    rows = poses.find(relations.stamps)
    used = (rows >= 0).all(axis=1) & (np.hypot(*relations.T_1_2[:, :2].T) <= certificate["within"])
    used &= (poses.maps[rows] == 0).all(axis=1)
    ends = poses.T_map_base[rows[used]].transpose(1, 0, 2)
    error_m, _ = motion_errors(relations.T_1_2[used], se2.between(*ends))
    cells = cKDTree([(cell["x"], cell["y"]) for cell in certificate["cells"]])
    bound_m = np.array([cell["bound_95"] for cell in certificate["cells"]])
    at = np.concatenate([cells.query(end[:, :2])[1] for end in ends])
    count = np.bincount(at, minlength=len(bound_m))
    squares = np.bincount(at, np.tile(error_m**2, 2), minlength=len(bound_m))
    known = count > 0
    return bound_m[known], np.sqrt(squares[known] / count[known])


def _shares(bound, error, bar_m=0.05):
    said, worse = bound <= bar_m, error > bar_m
    right = 100.0 * (~worse)[said].mean() if said.any() else np.nan
    flagged = 100.0 * (~said)[worse].mean() if worse.any() else np.nan
    return (len(bound), int(said.sum()), right, int(worse.sum()), flagged,
            *np.percentile(error / (bound / QUANTILE), (50, 95)))  # fmt: skip


if __name__ == "__main__":
    main()
