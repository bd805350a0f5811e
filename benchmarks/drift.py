"""How far does a robot drift between loops: heading and position of the tracker alone, in published floors?

    FCSLAM_DATA=/path/to/data python benchmarks/drift.py --work build/drift

One robot drives for three and a half minutes through each of 14 floors (`worlds/floor_worlds.py`), with each of three
scanners. Its scans are tracked one after the other, without loop closures. The error of a stretch of 25, 50 or
100 m of path is the motion over it by the tracker, against the true one: of its heading, and of its position. Stretches
begin every 2 m. A drive that is shorter gives none.
"""

from collections.abc import Iterator
from pathlib import Path

import common
import numpy as np
from worlds.floor_worlds import FLOORS, drive

from fcslam.geometry import se2
from fcslam.metrics.trajectory import interpolate
from fcslam.mission.mission import MissionConfig
from fcslam.records import FloatArray
from fcslam.robot.calibrating import calibrated
from fcslam.robot.frontend import RobotFrontend
from fcslam.runs.tables import read_tum
from fcslam.sources import open_source

LENGTHS_M = 25.0, 50.0, 100.0
SCANNERS = "rplidar", "sick", "short"
ODOMETRY = {"wheels": (), "none": ("--no-odometry",)}
SUMMARY = {"odometry": "", "scanner": "", "length, m": ".0f", "drives": "", "heading (RMS), deg": ".2f",
           "heading, mean, deg": "+.2f", "position (RMS), m": ".3f"}  # fmt: skip
COLUMNS = {"odometry": "", "scanner": "", "floor": "", "length, m": ".0f", "heading (RMS), deg": ".2f",
           "heading, mean, deg": "+.2f", "position (RMS), m": ".3f"}  # fmt: skip


def main() -> None:
    parser = common.options(__doc__)
    parser.add_argument("--floors", nargs="+", choices=FLOORS, default=FLOORS)
    parser.add_argument("--seed", type=int, default=11)
    parser.add_argument("--work", type=Path, default=common.REPOSITORY / "build" / "drift", help="folder of the drives")
    chosen = parser.parse_args()
    common.recordings(kind="floors")
    rows = [row for floor in chosen.floors for row in drifts(floor, chosen.seed, chosen.work)]
    report = common.Report(__file__, __doc__, chosen)
    report.table("Summary", SUMMARY, list(summary(rows)))
    report.table("Drives", COLUMNS, rows)
    report.write()


def drifts(floor: str, seed: int, work: Path) -> Iterator[tuple]:
    for scanner in SCANNERS:
        for odometry, options in ODOMETRY.items():
            folder = work / f"{floor}-{seed}-{scanner}-{odometry}"
            drive(floor, folder, "--seed", seed, "--robots", 1, "--minutes", 3.5, "--scanners", scanner, *options)
            found, truth = tracked(folder / "anna", folder / "anna.truth.tum")
            travel_m = np.append(0.0, np.cumsum(np.hypot(*np.diff(truth[:, :2], axis=0).T)))
            for length_m in LENGTHS_M:
                begin = np.searchsorted(travel_m, np.arange(0.0, travel_m[-1] - length_m, 2.0))
                end = np.searchsorted(travel_m, travel_m[begin] + length_m)
                begin, end = begin[end < len(travel_m)], end[end < len(travel_m)]
                if len(begin):
                    off = se2.between(se2.between(truth[begin], truth[end]), se2.between(found[begin], found[end]))
                    turn = np.degrees(off[:, 2])
                    errors = np.sqrt(np.mean(turn**2)), np.mean(turn), np.sqrt(np.mean(off[:, 0] ** 2 + off[:, 1] ** 2))
                    yield odometry, scanner, floor, length_m, *errors


def tracked(bag: Path, truth: Path) -> tuple[FloatArray, FloatArray]:
    """Poses of the first session at the scans by tracking alone, and the true ones, shape (N, 3) each."""
    config = MissionConfig().robot
    robot = RobotFrontend("anna", config)
    for record in calibrated(open_source(bag), config.lidar).records():
        robot.process(record)
    robot.finish()
    track = robot.tracks[0]
    stamps, poses = np.array([pose.stamp for pose in track]), np.array([track.in_odom(pose) for pose in track])
    true = interpolate(*read_tum(truth), stamps, gap_s=0.5)
    known = np.isfinite(true[:, 0])
    return poses[known], true[known]


def summary(rows: list[tuple]) -> Iterator[tuple]:
    for odometry in ODOMETRY:
        for scanner in (*SCANNERS, "all"):
            for length_m in LENGTHS_M:
                mine = [r[4:] for r in rows if r[0] == odometry and scanner in (r[1], "all") and r[3] == length_m]
                if mine:
                    heading, mean, position = np.array(mine).T
                    rms = (float(np.sqrt(np.mean(each**2))) for each in (heading, position))
                    yield odometry, scanner, length_m, len(mine), next(rms), float(mean.mean()), next(rms)


if __name__ == "__main__":
    main()
