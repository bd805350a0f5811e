"""Scanners that spin while the robot turns, odometry that is wrong, and none: how far are poses from the truth?

    FCSLAM_DATA=/path/to/data python benchmarks/spinning.py
    python benchmarks/spinning.py --logs --seeds 1 --path-length 10

One simulated robot drives in a building of each seed (`fcslam tools simulate`). Scanners
that spin measure each beam at its own time. The drive is written as a ROS 2 bag and mapped as `fcslam map` does. The
error is that of the positions at all scans after a rigid alignment.

Three logs of the SLAM benchmark are mapped without their odometry. Errors follow Kuemmerle et al. 2009 over all
relations.
"""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from itertools import product
from pathlib import Path
from tempfile import TemporaryDirectory

import common
import numpy as np
from robustness import Recording

from fcslam.lab.evaluation.relations import pose_table
from fcslam.lab.simulation.noise import SCANNERS, LidarSettings
from fcslam.lab.simulation.options import OdometryKind, Scanner
from fcslam.lab.simulation.simulated_fleet import SimulatedRobot, SimulationSettings, simulate_fleet
from fcslam.metrics.relations import read_relations, relation_errors
from fcslam.metrics.trajectory import PositionErrors, align, position_errors
from fcslam.mission.mission import MissionConfig, run_mission
from fcslam.records import LaserScan, frozen
from fcslam.robot.calibrating import calibrated
from fcslam.sources import Source, open_source
from fcslam.sources.bags.writer import write_bag

SLOW_RAD_S, FAST_RAD_S = 0.9, 2.0
COLUMNS = {"scanner": "", "turn rate, rad/s": ".1f", "odometry": "", "seed": "", "scans": "", "ATE (RMSE), m": ".4f",
           "max, m": ".3f"}  # fmt: skip
LOG_COLUMNS = {"log": "", "relations": "", "mean, m": ".4f", "max, m": ".3f", "mean, deg": ".3f"}


def main() -> None:
    parser = common.options(__doc__)
    parser.add_argument("--logs", nargs="*", default=tuple(common.SPLITS), choices=common.SPLITS, metavar="LOG")
    parser.add_argument("--seeds", nargs="+", type=int, default=(0, 1, 2), help="of the buildings")
    parser.add_argument("--path-length", type=float, default=60.0, help="of a simulated drive, metres")
    chosen = parser.parse_args()
    folder = common.recordings(*common.slam_benchmark_files()) if chosen.logs else None
    report = common.Report(__file__, __doc__, chosen)
    report.table("Simulated scanners", COLUMNS, list(simulate(chosen.seeds, chosen.path_length)))
    if chosen.logs:
        report.table("Logs without their odometry", LOG_COLUMNS, [without_odometry(folder, log) for log in chosen.logs])
    report.write()


def simulate(seeds: Sequence[int], path_m: float) -> Iterator[tuple[object, ...]]:
    scanners = [Scanner.INSTANT, *(scanner for scanner, lidar in SCANNERS.items() if lidar.spin)]
    cases = list(product(scanners, (SLOW_RAD_S, FAST_RAD_S), (OdometryKind.GOOD,)))
    cases += [(Scanner.LD19, FAST_RAD_S, kind) for kind in OdometryKind if kind is not OdometryKind.GOOD]
    cases += [(Scanner.RPLIDAR_A1, turn_rate, OdometryKind.NONE) for turn_rate in (SLOW_RAD_S, FAST_RAD_S)]
    for (scanner, turn_rate, kind), seed in product(cases, seeds):
        robot = drive(SCANNERS[scanner], turn_rate, kind, seed, path_m)
        with recorded(robot) as source:
            run = run_mission([source], MissionConfig())
        found, truth = run.trajectories[robot.name], robot.T_building_base
        if len(found.T_map_base) < len(truth):
            raise SystemExit(f"{scanner}, {turn_rate} rad/s, {kind}, seed {seed}: the map came apart")
        errors = PositionErrors.of(position_errors(align(truth, found.T_map_base), truth, found.T_map_base))
        yield scanner, turn_rate, kind, seed, len(truth), errors.rmse_m, errors.max_m


def drive(lidar: LidarSettings, turn_rate: float, kind: OdometryKind, seed: int, path_m: float) -> SimulatedRobot:
    settings = SimulationSettings(
        robots=1, path_length_m=path_m, camera=None, turn_rate_rad_s=turn_rate, lidar=lidar, odometry=kind
    )
    (robot,) = simulate_fleet(settings, seed).robots
    return robot


@contextmanager
def recorded(robot: SimulatedRobot) -> Iterator[Source]:
    """The robot's ROS 2 bag, read and calibrated as `fcslam map` does."""
    with TemporaryDirectory() as folder:
        path = Path(folder) / f"{robot.name}.mcap"
        write_bag(path, robot.scans())
        yield calibrated(open_source(path), MissionConfig().robot.lidar)


def without_odometry(folder: Path, name: str) -> tuple[object, ...]:
    unknown = frozen(np.full(3, np.nan))
    records = open_source(common.log_path(folder, name)).records()
    scans = [replace(record, T_odom_base=unknown) for record in records if isinstance(record, LaserScan)]
    run = run_mission([Recording(name, scans)], MissionConfig())
    errors = relation_errors(read_relations(common.relations_path(folder, name)), pose_table(run))
    return name, errors.used, errors.translation.mean, errors.translation.maximum, errors.rotation.mean


if __name__ == "__main__":
    main()
