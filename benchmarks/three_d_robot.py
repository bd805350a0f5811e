"""One robot with a 3D LiDAR: how exact is its trajectory with wheels, with an IMU, with both and with neither?

    python benchmarks/three_d_robot.py /path/to/bags
    python benchmarks/three_d_robot.py /path/to/bags --drives ramp-32 --sensors neither

Bags are of a simulator outside of this repository: a corridor with rooms, furniture and a ceiling. Robots have 16 rings
at 10 Hz, turns of up to 1.2 rad/s, wheels whose scale is off by 1.5 % and whose turns are off by 3 %, and an IMU with
biases of 0.01 rad/s. `ramp-<seed>` goes up a ramp of 1.4 m between plain walls, `flat-<seed>` has no ramp. Beside each
bag, `<bag>.truth.tum` has the true pose at each turn of the LiDAR.

The trajectory is that of the robot alone, before any cloud. Errors are those of the positions after one rigid
alignment, which rotations fix, too. The CPU time is that of a turn, with reading the bag; the uplink is that of all
packets, and the memory that of the process at the end of the drive. `long-<seed>` takes ten minutes.
"""

import os
import time
from dataclasses import replace
from functools import partial
from pathlib import Path

import common
import numpy as np
from three_d import errors_of

from fcslam.records import CloudScan
from fcslam.robot.backend import SessionConfig
from fcslam.robot.frontend3d import RobotFrontend3d
from fcslam.runs.tables import read_tum_6d
from fcslam.sources import BagOptions, open_fleet
from fcslam.wire.packets import measure

SENSORS = {"wheels, IMU": (True, True), "wheels": (True, False), "IMU": (False, True), "neither": (False, False)}
DRIVES = "flat-7", "flat-202", "ramp-32", "ramp-101", "ramp-303", "ramp-404"
LONG = ("long-66",)
COLUMNS = {"drive": "", "turns": "", "sessions": "", "ATE (RMSE), m": ".4f", "in the plane, m": ".4f",
           "max, m": ".3f", "rotation, deg": ".3f", "CPU, ms a turn": ".1f", "uplink, kB/s": ".1f",
           "memory, MB": ".0f"}  # fmt: skip


def main() -> None:
    parser = common.options(__doc__)
    parser.add_argument("bags", type=Path, help="folder of the bags")
    parser.add_argument("--drives", nargs="+", default=DRIVES)
    parser.add_argument("--sensors", nargs="+", choices=SENSORS, default=tuple(SENSORS))
    parser.add_argument("--long", nargs="*", default=LONG, help="long drives, with wheels and an IMU")
    parser.add_argument("--kept", type=Path, help="file that keeps finished drives, so that an interrupted run goes on")
    chosen = parser.parse_args()
    kept, report = common.Kept(chosen.kept), common.Report(__file__, __doc__, chosen)
    tables = [(f"Besides the LiDAR: {sensors}", chosen.drives, sensors) for sensors in chosen.sensors]
    for title, drives, sensors in (*tables, ("Ten minutes, with wheels and an IMU", chosen.long, next(iter(SENSORS)))):
        rows = []
        for drive in drives:
            rows += kept.rows((drive, sensors), partial(rows_of, chosen.bags / drive, sensors))
            print(sensors, *rows[-1], flush=True)
        report.table(title, COLUMNS, rows)
    report.write()


def rows_of(bag: Path, sensors: str) -> list[tuple[object, ...]]:
    has_wheels, has_imu = SENSORS[sensors]
    [source] = open_fleet([(bag, "anna")], BagOptions(in_3d=True))
    robot, packets = RobotFrontend3d("anna", SessionConfig()), []
    began = time.process_time()
    for scan in source.records():
        assert isinstance(scan, CloudScan)
        kept = replace(scan, wheels=scan.wheels[: None if has_wheels else 0], imu=scan.imu[: None if has_imu else 0])
        packets += robot.process(kept)
    packets += robot.finish()
    cpu_s = time.process_time() - began
    memory_mb = int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6
    stamps, poses = read_tum_6d(Path(f"{bag}.truth.tum"))
    track = max(robot.tracks, key=len)
    true = poses[np.abs(stamps[:, None] - track.stamps).argmin(axis=0)]
    uplink = sum(len(measure(packet).data) for packet in packets) / 1e3 / float(np.ptp(stamps))
    errors = errors_of(track.T_odom_base(), true)
    return [(bag.name, len(stamps), len(robot.tracks), *errors, 1e3 * cpu_s / len(stamps), uplink, memory_mb)]


if __name__ == "__main__":
    main()
