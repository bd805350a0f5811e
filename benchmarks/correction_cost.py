"""What it costs to correct a scan for the motion during it: CPU time of a scan, spinning against all beams at once.

    python benchmarks/correction_cost.py [--seeds 0 1 2] [--path-length 60]

One simulated robot drives in a building of each seed, with an LD19 and with the same LiDAR that measures all beams at
once. Front and back end map both drives in turn, in one process. Each time is the median of the turns, each ratio the
median of the ratios of a turn. Run it on a quiet machine.
"""

import time
from collections.abc import Iterator, Sequence
from itertools import product

import common
import numpy as np
from spinning import FAST_RAD_S, SLOW_RAD_S, drive, recorded

from fcslam.lab.simulation.noise import SCANNERS
from fcslam.lab.simulation.options import OdometryKind, Scanner
from fcslam.records import LaserScan, SensorRecord
from fcslam.robot.frontend import RobotConfig, RobotFrontend

TURNS = 7
COLUMNS = {"turn rate, rad/s": ".1f", "seed": "", "scans": "", "at once, ms a scan": ".3f",
           "corrected, ms a scan": ".3f", "ratio": ".3f"}  # fmt: skip


def main() -> None:
    parser = common.options(__doc__ or "")
    parser.add_argument("--seeds", nargs="+", type=int, default=(0, 1, 2), help="of the buildings")
    parser.add_argument("--path-length", type=float, default=60.0, help="of a drive, metres")
    chosen = parser.parse_args()
    report = common.Report(__file__, __doc__ or "", chosen)
    rows = list(costs(chosen.seeds, chosen.path_length))
    report.table("CPU time of a scan", COLUMNS, rows)
    report.say(f"The median ratio is {np.median([row[-1] for row in rows]):.3f}.")
    report.write()


def costs(seeds: Sequence[int], path_m: float) -> Iterator[tuple[float, ...]]:
    spinning = SCANNERS[Scanner.LD19]
    for turn_rate, seed in product((SLOW_RAD_S, FAST_RAD_S), seeds):
        arms = []
        for lidar in (spinning.model_copy(update={"spin": 0}), spinning):
            with recorded(drive(lidar, turn_rate, OdometryKind.GOOD, seed, path_m)) as source:
                arms.append(list(source.records()))
        scans = sum(isinstance(record, LaserScan) for record in arms[1])
        turns = [[cpu_of_scan_ms(records) for records in arms] for _ in range(1 + TURNS)]
        times_ms = np.array(turns[1:])  # the first one loads compiled code
        yield turn_rate, seed, scans, *np.median(times_ms, axis=0), np.median(times_ms[:, 1] / times_ms[:, 0])


def cpu_of_scan_ms(records: Sequence[SensorRecord]) -> float:
    frontend = RobotFrontend("robot", RobotConfig())
    began = time.process_time()
    for record in records:
        frontend.process(record)
    frontend.finish()
    return 1e3 * (time.process_time() - began) / sum(isinstance(record, LaserScan) for record in records)


if __name__ == "__main__":
    main()
