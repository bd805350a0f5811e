"""Whether a scan takes longer as the map grows: one robot's whole work on the intel log, scan by scan, in one process.

    FCSLAM_DATA=/path/to/data python benchmarks/time_per_scan.py

A pass over mit-csail before it compiles (or loads) every kernel and is not counted. CPU is the process's user and
system time, all threads. Memory is the resident set, so it holds the reader, the robot and its map.
"""

import gc
import os
import time
from pathlib import Path

import common
import numpy as np

from fcslam.records import LaserScan
from fcslam.robot.frontend import RobotConfig, RobotFrontend
from fcslam.sources import open_source
from fcslam.wire.messages import PacketKind
from fcslam.wire.packets import encode, read_label

TENTHS = {"tenth": "", "scans": "", "odometry so far, m": ".0f", "keyscans so far": "", "mean CPU, ms": ".3f",
          "median CPU, ms": ".3f", "99 %, ms": ".2f", "max, ms": ".1f", "memory at its end, MB": ".1f"}  # fmt: skip


def main() -> None:
    chosen = common.options(__doc__).parse_args()
    folder = common.recordings(*common.slam_benchmark_files())
    report = common.Report(__file__, __doc__, chosen)
    drive(common.log_path(folder, "mit-csail"))
    gc.collect()
    cpu_ms, wall_ms, state = drive(common.log_path(folder, "intel"))
    fifth = len(cpu_ms) // 5
    first, last = cpu_ms[:fifth], cpu_ms[-fifth:]
    report.table(
        "Growth",
        {"": "", "first 20 %": ".3f", "last 20 %": ".3f", "ratio": ".2f"},
        [(f"{what} CPU, ms", f(first), f(last), f(last) / f(first)) for what, f in
         (("mean", np.mean), ("median", np.median))],
    )  # fmt: skip
    quantiles = (50, 90, 99, 99.9, 100)
    report.table(
        "A scan",
        {"": "", "mean, ms": ".3f", **{f"{q:g} %, ms": ".2f" for q in quantiles}},
        [(what, ms.mean(), *np.percentile(ms, quantiles)) for what, ms in (("CPU", cpu_ms), ("wall", wall_ms))],
    )
    report.table("Along the log", TENTHS, tenths(cpu_ms, state))
    grown_mb, path_m = state[-1, [2, 0]] - state[len(state) // 10, [2, 0]]
    report.say(f"Memory grew by {grown_mb:.1f} MB over the last nine tenths, {1e3 * grown_mb / path_m:.0f} kB a metre.")
    report.write()


def drive(path: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """CPU and wall milliseconds of each scan, shape (N,); path m, keyscans and memory MB after it, shape (N, 3)."""
    robot = RobotFrontend("robot", RobotConfig())
    cpu_ms, wall_ms, state = [], [], []
    keyscans, path_m, last = 0, 0.0, None
    for record in open_source(path).records():
        wall, cpu = time.perf_counter(), time.process_time()
        packets = [encode(packet) for packet in robot.process(record)]
        spent = (time.process_time() - cpu, time.perf_counter() - wall)
        if isinstance(record, LaserScan):
            last, before = record.T_odom_base, record.T_odom_base if last is None else last
            path_m += float(np.hypot(*(last - before)[:2]))
            keyscans += sum(read_label(packet).kind == PacketKind.KEYSCAN for packet in packets)
            cpu_ms.append(1e3 * spent[0])
            wall_ms.append(1e3 * spent[1])
            state.append((path_m, keyscans, resident_mb()))
    return np.array(cpu_ms), np.array(wall_ms), np.array(state)


def tenths(cpu_ms: np.ndarray, state: np.ndarray) -> list[tuple]:
    rows = []
    for number, part in enumerate(np.array_split(np.arange(len(cpu_ms)), 10), start=1):
        ms, (path_m, keyscans, memory_mb) = cpu_ms[part], state[part[-1]]
        middle = (ms.mean(), np.median(ms), np.percentile(ms, 99), ms.max())
        rows.append((number, len(part), path_m, int(keyscans), *middle, memory_mb))
    return rows


def resident_mb() -> float:
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


if __name__ == "__main__":
    main()
