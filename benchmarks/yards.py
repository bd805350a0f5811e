"""Simulated yards, one robot each: does the map stay whole outdoors, with good odometry and with slipping wheels?

    python benchmarks/yards.py
    python benchmarks/yards.py --seeds 1 2 --odometry good

Trees, hedges, parked cars, glass, slopes and open ground (benchmarks/worlds/yard.py). Five scanners take turns over the
seeds, and drives of 300 to 750 m come back to their start. Errors are of positions at all scans after alignment
(SE(2), least squares): their mean is the ATE here. A slip is an error of the motion over 1 s, or from scan to
scan if that is longer. A closure is wrong if it is off by more than 0.5 m or 10 deg. A robot that believes itself
lost begins a new session; "apart" is the share of scans of sessions that end in another map than most.

Passed: an ATE of at most 0.20 m, no slip over 0.5 m, nothing apart; the script fails otherwise.
"""

import sys
import time
from collections import Counter
from collections.abc import Iterator
from typing import NamedTuple

import common
import numpy as np
from numpy.typing import NDArray
from robustness import Recording, position_errors
from worlds.yard import Yard

from fcslam.geometry import se2
from fcslam.lab.simulation.noise import LidarSettings
from fcslam.lab.simulation.options import OdometryKind
from fcslam.lab.simulation.simulated_fleet import SimulatedRobot, SimulationSettings, simulate_fleet
from fcslam.mission.mission import MissionConfig, run_mission
from fcslam.records import ClosureStatus, FloatArray
from fcslam.runs import Run

WORST_MEAN_M, WORST_SLIP_M = 0.20, 0.5
WRONG_M, WRONG_RAD = 0.5, np.radians(10.0)
SEEDS = tuple(range(1, 11))
SHORTEST_M, LONGER_M = 300.0, 50.0


class Scanner(NamedTuple):
    """A LiDAR on the market, about."""

    name: str
    beams: int
    field_of_view_deg: float
    max_range_m: float
    rate_hz: float


SCANNERS = (
    Scanner("181 x 180 deg, 81.9 m", 181, 180.0, 81.9, 1.67),
    Scanner("361 x 180 deg, 81.9 m", 361, 180.0, 81.9, 5.0),
    Scanner("360 x 360 deg, 30 m", 360, 360.0, 30.0, 10.0),
    Scanner("180 x 180 deg, 80 m", 180, 180.0, 80.0, 1.5),
    Scanner("541 x 270 deg, 30 m", 541, 270.0, 30.0, 10.0),
)
COLUMNS = {"odometry": "", "seed": "", "scanner": "", "Hz": ".2f", "path, m": ".0f", "scans": ",",
           "odometry: mean, m": ".2f", "max, m": ".2f", "slip, m": ".2f", "ATE, m": ".3f", "max, m ": ".3f",
           "slip, m ": ".3f", "after, m": ".0f", "closures": "", "wrong": "", "apart": ".2f", "CPU, s": ".1f",
           "passed": ""}  # fmt: skip
SUMMARY = {"odometry": "", "yards": "", "passed": "", "mean ATE, m": ".3f", "worst ATE, m": ".3f",
           "worst slip, m": ".3f", "wrong closures": "", "CPU, s": ".0f"}  # fmt: skip


def main() -> None:
    parser = common.options(__doc__)
    kinds = [kind for kind in OdometryKind if kind is not OdometryKind.DEFAULT]
    parser.add_argument("--seeds", nargs="+", type=int, default=SEEDS, help="of the yards")
    parser.add_argument("--odometry", nargs="+", type=OdometryKind, choices=kinds, default=kinds, help="kinds of it")
    chosen = parser.parse_args()
    report = common.Report(__file__, __doc__, chosen)
    rows = []
    for kind in chosen.odometry:
        for seed in chosen.seeds:
            rows.append(row(kind, seed))
            print(*rows[-1], flush=True)
    report.table("Summary", SUMMARY, summary(rows))
    report.table("Yards", COLUMNS, rows)
    report.write()
    if any(row[-1] == "NO" for row in rows):
        sys.exit("a yard did not pass")


def row(kind: OdometryKind, seed: int) -> tuple:
    scanner = SCANNERS[seed % len(SCANNERS)]
    robot = simulated_robot(kind, seed, scanner)
    began = time.process_time()
    run = run_mission([Recording(robot.name, list(robot.scans()))], MissionConfig())
    cpu_s = time.process_time() - began
    truth, (kept, found) = robot.T_building_base, largest_map(run, robot)
    driven_m = np.insert(np.cumsum(np.hypot(*np.diff(truth[:, :2], axis=0).T)), 0, 0.0)
    odometry_slip_m, _ = worst_slip(robot.stamps, robot.T_odom_base, truth)
    slip_m, slipped = worst_slip(robot.stamps[kept], found, truth[kept])
    errors, apart = position_errors(found, truth[kept]), 1.0 - len(kept) / len(truth)
    passed = errors[0] <= WORST_MEAN_M and slip_m <= WORST_SLIP_M and not apart
    return (
        str(kind), seed, scanner.name, scanner.rate_hz, driven_m[-1], len(truth),
        *position_errors(robot.T_odom_base, truth), odometry_slip_m, *errors, slip_m, driven_m[kept[slipped]],
        *closure_counts(run, robot), apart, cpu_s, "yes" if passed else "NO",
    )  # fmt: skip


def simulated_robot(kind: OdometryKind, seed: int, scanner: Scanner) -> SimulatedRobot:
    lidar = LidarSettings(
        beams=scanner.beams,
        field_of_view_rad=np.radians(scanner.field_of_view_deg),
        max_range_m=scanner.max_range_m,
        rate_hz=scanner.rate_hz,
    )
    settings = SimulationSettings(
        robots=1,
        path_length_m=SHORTEST_M + LONGER_M * (seed % 10),
        lidar=lidar,
        odometry=kind,
        camera=None,
    )
    return simulate_fleet(settings, seed, Yard()).robots[0]


def largest_map(run: Run, robot: SimulatedRobot) -> tuple[NDArray[np.intp], FloatArray]:
    """Numbers of the scans in the map of most scans, shape (N,), and their poses there, shape (N, 3)."""
    parts = list(run.trajectories.values())
    sizes: Counter[int] = Counter()
    for part in parts:
        sizes[part.map_index] += len(part.stamps)
    largest = [part for part in parts if part.map_index == sizes.most_common(1)[0][0]]
    scans = np.concatenate([np.searchsorted(robot.stamps, part.stamps - 1e-6) for part in largest])
    order = np.argsort(scans)
    return scans[order], np.concatenate([part.T_map_base for part in largest])[order]


def worst_slip(stamps: FloatArray, poses: FloatArray, truth: FloatArray) -> tuple[float, int]:
    """Largest error of a position as seen from 1 s before, or from the scan before, and the number of that scan."""
    before = np.minimum(np.searchsorted(stamps, stamps - 1.0 - 1e-6), np.arange(len(stamps)) - 1)[1:]
    off = se2.between(se2.between(truth[before], truth[1:]), se2.between(poses[before], poses[1:]))
    distance = np.hypot(off[:, 0], off[:, 1])
    worst = int(np.argmax(distance))
    return float(distance[worst]), worst + 1


def closure_counts(run: Run, robot: SimulatedRobot) -> tuple[int, int]:
    """Accepted closures, and those of them that are wrong."""
    accepted = [closure for closure in run.closures if closure.status is ClosureStatus.ACCEPTED]
    wrong = 0
    for closure in accepted:
        i, j = np.argmin(np.abs(np.subtract.outer((closure.stamp_i, closure.stamp_j), robot.stamps)), axis=1)
        true = se2.between(robot.T_building_base[i], robot.T_building_base[j])
        x, y, turn = se2.between(true, closure.T_i_j)
        wrong += bool(np.hypot(x, y) > WRONG_M or abs(turn) > WRONG_RAD)
    return len(accepted), wrong


def summary(rows: list[tuple]) -> Iterator[tuple]:
    for kind in dict.fromkeys(row[0] for row in rows):
        some = [dict(zip(COLUMNS, row, strict=True)) for row in rows if row[0] == kind]
        ates = [row["ATE, m"] for row in some]
        passed = sum(row["passed"] == "yes" for row in some)
        wrong, cpu_s = (sum(row[name] for row in some) for name in ("wrong", "CPU, s"))
        slip_m = max(row["slip, m "] for row in some)
        yield kind, len(some), passed, sum(ates) / len(ates), max(ates), slip_m, wrong, cpu_s


if __name__ == "__main__":
    main()
