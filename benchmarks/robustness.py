"""Eleven buildings, odometry made noisy: does the map stay whole?

    FCSLAM_DATA=/path/to/data python benchmarks/robustness.py
    FCSLAM_DATA=/path/to/data python benchmarks/robustness.py --logs fhw seattle --seeds 0

The logs hold poses that a particle filter corrected, good to 5 to 10 cm: they are the reference, and odometry is drawn
from them with noise. Errors are of positions after alignment (SE(2), least squares). Most logs hold one scan every
metre or so; stamps are missing in some, so each scan is given the next second. A closure contradicts the
reference if it is more than 1 m off.
"""

import itertools
import time
from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import common
import numpy as np

from fcslam.geometry import se2
from fcslam.geometry.alignment import n_point_alignment
from fcslam.mission.mission import MissionConfig, run_mission
from fcslam.records import ClosureStatus, FloatArray, LaserScan, frozen
from fcslam.runs import Run
from fcslam.sources import Source, open_source
from fcslam.sources.faults import Faults

LOGS = ("acapulco", "belgioioso", "csail", "edmonton", "fhw", "freiburg-101", "freiburg-campus", "orebro", "seattle",
        "intel", "freiburg-079")  # fmt: skip
STEP_S, CONTRADICTION_M = 1.0, 1.0
TRAVEL_NOISE, STANDING_NOISE_M = 0.03, 0.002
"""Standard deviation in each direction, a metre of a step's travel and besides."""
HEADING_NOISE_RAD, TURN_NOISE = 0.02, 0.05
"""Standard deviation of the heading after 1 m (it grows with the root), and a radian of turning."""
COLUMNS = {"log": "", "seed": "", "scans": ",", "path, m": ".0f", "odometry: mean, m": ".2f", "max, m": ".2f",
           "fcslam: mean, m": ".3f", "fcslam: max, m": ".3f", "closures": "", "revoked": "",
           "contradict the reference": "", "CPU, s": ".1f"}  # fmt: skip

SUMMARY = {"log": "", "seeds": "", "odometry: mean, m": ".2f", "fcslam: mean, m": ".3f", "worst seed: mean, m": ".3f",
           "worst seed: max, m": ".3f", "closures that contradict the reference": ""}  # fmt: skip


def main() -> None:
    parser = common.options(__doc__)
    parser.add_argument("--logs", nargs="+", default=LOGS, choices=LOGS, metavar="LOG", help="only these")
    parser.add_argument("--seeds", nargs="+", type=int, default=range(10), help="of the odometry's noise")
    chosen = parser.parse_args()
    files = {name: f"rbpf-corrected/{name}-corrected.log.gz" for name in chosen.logs}
    folder = common.recordings(*files.values())
    report = common.Report(__file__, __doc__, chosen)
    rows = [row(name, open_source(folder / files[name]), seed) for name in chosen.logs for seed in chosen.seeds]
    report.say(
        f"Odometry noise of a step of d m that turns by a rad: N(0, {TRAVEL_NOISE} d + {STANDING_NOISE_M}) m in each "
        f"direction, N(0, {HEADING_NOISE_RAD} sqrt(d) + {TURN_NOISE} a) rad."
    )
    report.table("Logs", SUMMARY, summary(rows))
    report.table("Corrected logs with noisy odometry", COLUMNS, rows)
    report.write()


def summary(rows: list[tuple]) -> list[tuple]:
    """A row for each log: means over the seeds, and the worst one."""
    logs = []
    for name, of_log in itertools.groupby(rows, key=lambda row: row[0]):
        *_, odometry, _, mean, most, _, _, contradict, _ = map(np.array, zip(*of_log, strict=True))
        logs.append((name, len(mean), odometry.mean(), mean.mean(), mean.max(), most.max(), int(contradict.sum())))
    return logs


@dataclass(frozen=True)
class Recording:
    """A recording in memory, as a mission reads it."""

    name: str
    scans: list[LaserScan]
    faults: Faults = field(default_factory=lambda: Faults({}))

    def records(self) -> Iterator[LaserScan]:
        return iter(self.scans)


def row(name: str, source: Source, seed: int) -> tuple:
    recorded = [record for record in source.records() if isinstance(record, LaserScan)]
    reference = np.array([scan.T_odom_base for scan in recorded])
    odometry = noisy(reference, np.random.default_rng(seed))
    scans = [
        replace(scan, stamp=STEP_S * k, T_odom_base=frozen(pose))
        for k, (scan, pose) in enumerate(zip(recorded, odometry, strict=True))
    ]
    began = time.process_time()
    run = run_mission([Recording(name, scans)], MissionConfig())
    cpu_s = time.process_time() - began
    path_m = np.hypot(*np.diff(reference[:, :2], axis=0).T).sum()
    errors = (*position_errors(odometry, reference), *position_errors(run.trajectories[name].T_map_base, reference))
    return name, seed, len(scans), path_m, *errors, *closure_counts(run, reference), cpu_s


def noisy(poses: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Odometry (N, 3), from zero, of a robot that drove along ``poses``."""
    steps = se2.relative(poses)
    travel_m = np.hypot(steps[:, 0], steps[:, 1])
    sigma_m = TRAVEL_NOISE * travel_m + STANDING_NOISE_M
    sigma_rad = HEADING_NOISE_RAD * np.sqrt(travel_m) + TURN_NOISE * np.abs(steps[:, 2])
    steps = steps + rng.standard_normal(steps.shape) * np.column_stack((sigma_m, sigma_m, sigma_rad))
    chain = [np.zeros(3)]
    for step in steps:
        chain.append(se2.compose(chain[-1], step))
    return np.array(chain)


def position_errors(poses: FloatArray, reference: FloatArray) -> tuple[float, float]:
    """Mean and maximum distance in metres after alignment."""
    T = n_point_alignment(reference[:, :2], poses[:, :2])
    distance = np.hypot(*(se2.transform(T, poses[:, :2]) - reference[:, :2]).T)
    return float(distance.mean()), float(distance.max())


def closure_counts(run: Run, reference: FloatArray) -> tuple[int, int, int]:
    """Accepted closures, revoked ones, and accepted ones that contradict the reference."""
    accepted = [closure for closure in run.closures if closure.status is ClosureStatus.ACCEPTED]
    revoked = sum(closure.status is ClosureStatus.REVOKED for closure in run.closures)
    ends = np.array([(c.stamp_i, c.stamp_j) for c in accepted]).reshape(-1, 2)
    i, j = np.rint(ends / STEP_S).astype(int).T
    measured = np.array([closure.T_i_j for closure in accepted]).reshape(-1, 3)
    off = se2.between(se2.between(reference[i], reference[j]), measured)
    return len(accepted), revoked, int(np.sum(np.hypot(off[:, 0], off[:, 1]) > CONTRADICTION_M))


if __name__ == "__main__":
    main()
