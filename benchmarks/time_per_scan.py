"""How long a scan takes as the map grows: one robot on the intel log, scan by scan.

    FCSLAM_DATA=/path/to/data python benchmarks/time_per_scan.py [--rounds 8]

- Inline, as in a recording: front end, back end and encoding in one process, once over the log.
- Live, as in `fcslam robot`: the back end in a process beside, the log many times over with odometry that goes on. A
  scan's time is that of the front end, until its pose and the packets that are ready are known. It is played as fast as
  the back end can follow; the waits for that are not counted, as a robot in real time has none. With fewer than two
  free cores the wall time includes that of the other process: CPU is that of the front end's thread.

Inline, a pass over mit-csail before compiles (or loads) every kernel and is not counted; live, the warm-up of
`fcslam robot` does. Memory inline is the resident set, with the reader, the robot and its map. Live it is the
proportional set of each process: of a page that both share, each counts half, so their sum is what both hold. The code
of `fcslam robot` is loaded, and the log is not in memory: the scans come from a file, some hundred at a time, as a
driver would send them. Run it while no other Python program runs, which would share pages too.
"""

import gc
import os
import re
import tempfile
import time
from collections.abc import Iterator
from multiprocessing import active_children
from pathlib import Path
from typing import Any

import common
import numpy as np
from scaling import Repeated, alone, back_to_the_start, scan_poses

from fcslam.cloud.cloud import Cloud
from fcslam.live.robot import LARGEST_BACKLOG
from fcslam.mission.mission import MissionConfig
from fcslam.records import LaserModel, LaserScan, frozen
from fcslam.robot.backend_runner import backend_process
from fcslam.robot.frontend import RobotConfig, RobotFrontend
from fcslam.sources import open_source
from fcslam.warmup import warm_up_tracking
from fcslam.wire.messages import PacketKind
from fcslam.wire.packets import encode, read_label

TENTHS = {"tenth": "", "scans": "", "odometry so far, m": ".0f", "keyscans so far": "", "mean CPU, ms": ".3f",
          "median CPU, ms": ".3f", "99 %, ms": ".2f", "max, ms": ".1f", "memory at its end, MB": ".1f"}  # fmt: skip
READ_AT_ONCE = 200
"""Scans that the live robot's driver has in memory."""
FEW_ROUNDS = 5
"""Memory is compared with that after so many rounds."""
QUANTILES = (50, 95, 99, 99.9, 100)
SCAN = {"": "", "mean, ms": ".3f", **{f"{q:g} %, ms": ".2f" for q in QUANTILES}, "longest at scan": ","}
ROUNDS = {"round": "", "scans": ",", "keyscans so far": ",", "mean, ms": ".3f", "99 %, ms": ".2f", "max, ms": ".1f",
          "front end, MB": ".0f", "back end, MB": ".0f"}  # fmt: skip


def main() -> None:
    parser = common.options(__doc__ or "")
    parser.add_argument("--rounds", type=int, default=8, help="of the log, live")
    chosen = parser.parse_args()
    folder = common.recordings(*common.slam_benchmark_files())
    report = common.Report(__file__, __doc__ or "", chosen)
    log = common.log_path(folder, "intel")
    report_live(report, log, chosen.rounds)
    report_inline(report, common.log_path(folder, "mit-csail"), log)
    report.write()


def report_inline(report: common.Report, first: Path, log: Path) -> None:
    drive(first)
    gc.collect()
    cpu_ms, wall_ms, state = drive(log)
    fifth = len(cpu_ms) // 5
    early, late = cpu_ms[:fifth], cpu_ms[-fifth:]
    report.table(
        "Inline: growth",
        {"": "", "first 20 %": ".3f", "last 20 %": ".3f", "ratio": ".2f"},
        [(f"{what} CPU, ms", f(early), f(late), f(late) / f(early)) for what, f in
         (("mean", np.mean), ("median", np.median))],
    )  # fmt: skip
    report.table("Inline: a scan", SCAN, [scan_row("CPU", cpu_ms), scan_row("wall", wall_ms)])
    report.table("Inline: along the log", TENTHS, tenths(cpu_ms, state))
    grown_mb, path_m = state[-1, [2, 0]] - state[len(state) // 10, [2, 0]]
    report.say(f"Memory grew by {grown_mb:.1f} MB over the last nine tenths, {1e3 * grown_mb / path_m:.0f} kB a metre.")


def report_live(report: common.Report, log: Path, rounds: int) -> None:
    said, rows = drive_live(log, rounds, alone(way_back, log))
    report.table(f"Live: a scan, intel {rounds} times over", SCAN, said)
    report.table("Live: round by round, wall", ROUNDS, rows)
    if rounds > FEW_ROUNDS:
        few, all_of_them = (sum(rows[number - 1][-2:]) for number in (FEW_ROUNDS, rounds))
        report.say(
            f"Both processes hold {few:.0f} MB after {FEW_ROUNDS} rounds and {all_of_them:.0f} MB after {rounds}, "
            f"{all_of_them / few:.2f} times as much, code included."
        )


def drive_live(log: Path, rounds: int, back: Any) -> tuple[list[tuple], list[tuple]]:
    """Rows of all scans and of each round; ``back``: as in ``Repeated``."""
    repeated = Repeated()
    repeated.back = back
    warm_up_tracking(RobotConfig())
    timed, rows = [], []
    with tempfile.TemporaryDirectory() as folder, backend_process("robot", RobotConfig()) as backend:
        laser = alone(save_scans, log, Path(folder))
        robot = RobotFrontend("robot", RobotConfig(), backend)
        (worker,) = active_children()
        for number in range(1, rounds + 1):
            part = np.array(list(live(repeated.scans(driver(laser, Path(folder))), robot)))
            repeated.end_round()
            timed.append(part)
            wall = part[:, 1]
            keyscans = robot.scan_poses[-1].keyscan + 1
            memory = proportional_mb(), proportional_mb(worker.pid)
            rows.append((number, len(part), keyscans, wall.mean(), np.percentile(wall, 99), wall.max(), *memory))
    cpu_ms, wall_ms = np.concatenate(timed).T
    return [scan_row("CPU", cpu_ms), scan_row("wall", wall_ms)], rows


def save_scans(log: Path, folder: Path) -> LaserModel:
    """Write stamp, ranges and odometry of each scan into one file each; returns their laser."""
    scans = [record for record in open_source(log).records() if isinstance(record, LaserScan)]
    np.save(folder / "stamps.npy", np.array([scan.stamp for scan in scans]))
    np.save(folder / "ranges.npy", np.array([scan.ranges_m for scan in scans]))
    np.save(folder / "poses.npy", np.array([scan.T_odom_base for scan in scans]))
    return scans[0].laser


def driver(laser: LaserModel, folder: Path) -> Iterator[LaserScan]:
    """The scans of ``save_scans``, some at a time."""
    files = [folder / f"{name}.npy" for name in ("stamps", "ranges", "poses")]
    begin = 0
    while True:
        mapped = [np.load(file, mmap_mode="r")[begin : begin + READ_AT_ONCE] for file in files]
        stamps, ranges, poses = (np.array(part) for part in mapped)
        del mapped  # pages of a mapped file would count
        if not len(stamps):
            return
        for stamp, ranges_m, pose in zip(stamps.tolist(), ranges, poses, strict=True):
            yield LaserScan(stamp, frozen(ranges_m, np.float32), laser, frozen(pose))
        begin += READ_AT_ONCE


def live(records: Any, robot: RobotFrontend) -> Iterator[tuple[float, float]]:
    """CPU milliseconds of the thread and wall milliseconds of each scan."""
    for record in records:
        if isinstance(record, LaserScan):
            wall, cpu = time.perf_counter(), time.thread_time()
            robot.process(record)
            yield 1e3 * (time.thread_time() - cpu), 1e3 * (time.perf_counter() - wall)
            while robot.packets.backlog > LARGEST_BACKLOG:
                time.sleep(0.01)
                robot.ready()


def way_back(log: Path) -> Any:
    """T_last_first of the log's optimized trajectory, shape (3,)."""
    source = open_source(log)
    config = MissionConfig()
    robot, cloud = RobotFrontend("robot", config.robot), Cloud(config.fleet, config.seed)
    for record in source.records():
        for packet in robot.process(record):
            cloud.receive(encode(packet))
    for packet in robot.finish():
        cloud.receive(encode(packet))
    return back_to_the_start(scan_poses(robot, cloud.finalize()))


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


def scan_row(what: str, ms: np.ndarray) -> tuple:
    return what, ms.mean(), *np.percentile(ms, QUANTILES), int(ms.argmax()) + 1


def tenths(cpu_ms: np.ndarray, state: np.ndarray) -> list[tuple]:
    rows = []
    for number, part in enumerate(np.array_split(np.arange(len(cpu_ms)), 10), start=1):
        ms, (path_m, keyscans, memory_mb) = cpu_ms[part], state[part[-1]]
        middle = (ms.mean(), np.median(ms), np.percentile(ms, 99), ms.max())
        rows.append((number, len(part), path_m, int(keyscans), *middle, memory_mb))
    return rows


def resident_mb(process: int | str = "self") -> float:
    pages = int(Path(f"/proc/{process}/statm").read_text(encoding="ascii").split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


def proportional_mb(process: int | str = "self") -> float:
    rollup = Path(f"/proc/{process}/smaps_rollup").read_text(encoding="ascii")
    return sum(map(int, re.findall(r"^Pss:\s+(\d+)", rollup, re.MULTILINE))) * 1024 / 1e6


if __name__ == "__main__":
    main()
