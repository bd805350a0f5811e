"""What is said about healthy recordings, and what is found in the same recordings after one fault.

    python benchmarks/healthy_robots.py --drives drives

One robot drives 2.5 min through each of 14 published floors, with each of three scanners and from each of five seeds.
Tf, clocks and beam times are exact. Odometry is off by 2 to 5 % in distance and as much in turns, and slips at times.
Each bag is read as `fcslam map` and `fcslam info` do, and every line about it counts as a claim. A line about the scale
of the odometry is true if the scale of the simulator is within 3 of its standard deviations, or within 0.01. Any other
line is untrue. Where a recording is corrected, its path is tracked as it is and as corrected. The error is that of the
positions at all scans after a rigid alignment.

The faulty recordings are 11 of these, changed: the laser sees the floor in a line 2 m ahead, it is turned by 90
degrees or upside down against tf, or its clock is behind by 0.25 s. Further
faults are in `recordings.py`. `--drives` names the folder of the bags; it is filled if they are missing. The recorded
logs have no truth, so their lines are listed.
"""

import math
import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from itertools import islice
from pathlib import Path

import common
import numpy as np
from convert_logs import readable
from worlds import floor_worlds

from fcslam.errors import SourceError
from fcslam.geometry import se2
from fcslam.lidar.facing import MOST_COMPARED, contradicted_facing
from fcslam.lidar.frontend import LidarConfig
from fcslam.lidar.leaning import floor_line
from fcslam.metrics.trajectory import align, interpolate
from fcslam.records import LaserScan, frozen
from fcslam.robot.calibrating import bodies_of, calibrate_bag, calibrated
from fcslam.robot.frontend import RobotConfig, RobotFrontend
from fcslam.runs.tables import read_tum
from fcslam.sources import open_source
from fcslam.sources.bags.options import BagCorrection
from fcslam.sources.bags.rosbag import RosBag
from fcslam.sources.source import Source

SCANNERS = ("rplidar", "sick", "short")
SEEDS = (1, 2, 3, 4, 5)
ROBOT = "anna"
KINDS = {
    "a leaning laser": "sees the floor",
    "facing": "contradict the odometry|topics of one robot",
    "scale of distances": "the robot's distance is",
    "scale of turns": "the robot's turn is",
    "clocks": "the clock of the odometry",
    "times of beams": "a scan takes|all beams of a scan",
    "mounting": "the laser is mounted",
    "the robot's own body": "see the robot itself",
    "ranges": "seem to be|repeats exactly",
    "faults of a record": "while the odometry|a laser saw nothing|skipped|kept|taken as|jumps of the odometry",
}
"""A pattern of the lines of each kind."""
LOGS = {
    "slam-benchmark": "*.clf.xz", "rosbag1": "*.bag", "ual-campus": "*.clf.xz", "mines-coreslam": "*.dat.gz",
    "duke-loop5": "*.log.gz", "wean-hall": "*.gz", "rbpf-corrected": "*.log.gz",
}  # fmt: skip
CORRECTED = "used", "corrected", "left out"
"""Ends of the lines about a recording that is read otherwise."""
FLOOR_M, LATE_S = 2.0, 0.25


def main() -> None:
    parser = common.options(__doc__)
    parser.add_argument("--drives", type=Path, required=True, help="folder of the bags")
    parser.add_argument("--seeds", type=int, nargs="+", default=SEEDS, help="of the drives")
    parser.add_argument("--keep", type=Path, help="file of rows, so that an interrupted run goes on")
    chosen = parser.parse_args()
    logs = common.recordings()
    kept, report = common.Kept(chosen.keep), common.Report(__file__, __doc__, chosen)
    robots = [(world, scanner, seed) for seed in chosen.seeds for world in floor_worlds.FLOORS for scanner in SCANNERS]
    said = [row for robot in robots for row in kept.rows(robot, lambda robot=robot: healthy(chosen.drives, *robot))]
    faulty = [
        row
        for robot in robots[: len(floor_worlds.FLOORS) * len(SCANNERS) : len(SCANNERS) + 1]
        for row in kept.rows((*robot, "faulty"), lambda robot=robot: changed(chosen.drives, *robot))
    ]
    lines = [row for row in said if row[1] != "path"]
    report.table(
        "Lines about healthy robots",
        {"line": "", "robots": "", "with it": "", "with an untrue one": "", "share untrue, %": ".1f"},
        [
            (kind, len(robots), *counts(kind, lines), 100 * counts(kind, lines)[1] / len(robots))
            for kind in kinds(lines)
        ],
    )
    paths = [row for row in said if row[1] == "path"]
    columns = {"robot": "", "as recorded, ATE (RMSE), m": ".4f", "as corrected": ".4f"}
    report.table("Corrected recordings", columns, [(robot, *errors) for robot, _, _, *errors in paths])
    found = {name: [row[2] for row in faulty if row[1] == name] for name in FAULTS}
    report.table(
        "Found in faulty recordings",
        {"fault": "", "robots": "", "found": ""},
        [(name, len(each), sum(each)) for name, each in found.items()],
    )
    report.table("Untrue lines", {"robot": "", "line": ""}, [(row[0], row[4]) for row in lines if not row[3]])
    report.table("Lines about recorded logs", {"log": "", "line": ""}, recorded(logs))
    report.write()


def kinds(lines: Sequence[tuple]) -> list[str]:
    """All kinds of lines, and those that are of no kind."""
    return [*KINDS, *sorted({row[2] for row in lines} - set(KINDS))]


def counts(kind: str, lines: Sequence[tuple]) -> tuple[int, int]:
    """Robots with a line of a kind, and with an untrue one."""
    of = [row for row in lines if row[2] == kind]
    return len({row[0] for row in of}), len({row[0] for row in of if not row[3]})


def healthy(drives: Path, world: str, scanner: str, seed: int) -> Iterator[tuple]:
    """Rows of one robot: each line with its kind and whether it is true, and the errors of a path that is corrected."""
    name, path, its = drive(drives, world, scanner, seed)
    bag = open_source(path)
    read = calibrated(bag, LidarConfig())
    lines = said_about(bag, read)
    for line in lines:
        kind = kind_of(line)
        yield name, "line", kind, is_true(kind, line, its), line
    if any(line.endswith(CORRECTED) for line in lines):
        truth = path.with_name(f"{ROBOT}.truth.tum")
        yield name, "path", "", error_m(bag, truth), error_m(read, truth)


def drive(drives: Path, world: str, scanner: str, seed: int) -> tuple[str, Path, dict]:
    """Name and bag of a robot, and what the simulator says about it."""
    name = f"{world}-{scanner}-{seed}"
    folder = drives / name
    folder.mkdir(parents=True, exist_ok=True)
    options = "--seed", seed, "--robots", 1, "--minutes", 2.5, "--scanners", scanner
    return name, folder / ROBOT, floor_worlds.drive(world, folder, *options)["robots"][ROBOT]


def said_about(source: Source, read: Source) -> list[str]:
    """The lines of `fcslam map` and `fcslam info` about a recording, and as it is calibrated, without its name."""
    for _ in read.records():
        pass
    lines = [*read.survey().notes, *bodies_of(source)]
    plain = [re.sub(r"^\S+: ", "", line).removesuffix("; not corrected") for line in lines]
    return list(dict.fromkeys(plain))


def kind_of(line: str) -> str:
    return next((kind for kind, pattern in KINDS.items() if re.search(pattern, line)), "other")


def is_true(kind: str, line: str, its: dict) -> bool:
    """Whether a line about a healthy robot is true."""
    if kind not in ("scale of distances", "scale of turns"):
        return False
    value, sigma = (float(each) for each in re.findall(r" is (\S+) of what odometry says \(\+- (\S+)\)", line)[0])
    true = 1.0 / its["scale" if kind == "scale of distances" else "yaw"]
    return abs(value - true) < max(3.0 * sigma, 0.01)


def error_m(source: Source, truth: Path) -> float:
    """Root mean square of the position errors of the local map."""
    frontend, off = RobotFrontend("r", RobotConfig()), []
    for record in source.records():
        frontend.process(record)
    frontend.finish()
    for track in frontend.tracks:
        true, found = interpolate(*read_tum(truth), np.array(track.stamps), gap_s=0.5), track.T_odom_base()
        known = np.isfinite(true[:, 0])
        off.append(se2.compose(align(true[known], found[known]), found[known])[:, :2] - true[known, :2])
    return float(np.sqrt(np.mean(np.sum(np.concatenate(off) ** 2, axis=1))))


def floor_ahead(scans: Sequence[LaserScan]) -> Iterator[LaserScan]:
    """The robot nods by 2 % of the distance."""
    rng = np.random.default_rng(1)
    for scan in scans:
        ahead = np.cos(scan.laser.angles_rad() + scan.laser.T_base_laser[2])
        floor_m = FLOOR_M * (1.0 + 0.02 * rng.normal()) / np.maximum(ahead, 1e-3) + rng.normal(0.0, 0.02, len(ahead))
        seen = np.fmin(scan.ranges_m, np.where(ahead > 0.1, floor_m, np.inf))
        yield replace(scan, ranges_m=frozen(seen, np.float32))


def turned(scan: LaserScan, by_rad: float) -> LaserScan:
    x, y, theta = scan.laser.T_base_laser
    return replace(scan, laser=replace(scan.laser, T_base_laser=(x, y, theta + by_rad)))


def upside_down(scan: LaserScan) -> LaserScan:
    laser = scan.laser
    mirrored = replace(laser, angle_min_rad=-laser.angle_min_rad, angle_increment_rad=-laser.angle_increment_rad)
    return replace(scan, laser=mirrored)


def is_found_turned(_: RosBag, scans: list[LaserScan]) -> bool:
    found = contradicted_facing(turned(scan, -math.pi / 2) for scan in scans)
    return found is not None and round(found.facing.turned_deg) == 90


def is_found_upside_down(_: RosBag, scans: list[LaserScan]) -> bool:
    found = contradicted_facing(map(upside_down, scans))
    return found is not None and found.facing.upside_down


def is_found_late(bag: RosBag, _: list[LaserScan]) -> bool:
    late = bag.corrected(BagCorrection(odometry_delay_s=-LATE_S), ())
    lines = calibrate_bag(late, LidarConfig()).lines
    return any(re.search(r"the clock of the odometry is 2[45]\d ms ahead", line) for line in lines)


FAULTS: dict[str, Callable[[RosBag, list[LaserScan]], bool]] = {
    "sees the floor": lambda _, scans: floor_line(list(floor_ahead(scans))) is not None,
    "turned by 90 deg": is_found_turned,
    "upside down": is_found_upside_down,
    "another clock": is_found_late,
}


def changed(drives: Path, world: str, scanner: str, seed: int) -> Iterator[tuple]:
    """Rows of one robot: each fault, and whether it is found."""
    name, path, _ = drive(drives, world, scanner, seed)
    bag = open_source(path)
    scans = [each for each in islice(bag.records(), 4 * MOST_COMPARED) if isinstance(each, LaserScan)]
    for fault, is_found in FAULTS.items():
        yield name, fault, bool(is_found(bag, scans[:MOST_COMPARED]))


def recorded(folder: Path) -> Iterator[tuple[str, str]]:
    """What is said about the recorded logs."""
    for part, pattern in LOGS.items():
        for path in sorted((folder / part).glob(pattern)):
            try:
                source = open_source(readable(path))
                lines = said_about(source, calibrated(source, LidarConfig()))
            except SourceError as error:
                lines = [f"refused: {error}".replace(str(folder), "")]
            yield from ((f"{part}/{path.name}", line) for line in lines or ["-"])


if __name__ == "__main__":
    main()
