"""What `fcslam.Robot` costs: its overhead over the bare front end, scan in to pose out, and the CPU of one live robot.

    FCSLAM_DATA=/path/to/data python benchmarks/live_class.py [--log fr079] [--seconds 60]

- Overhead: the same scans go to the bare front end of a robot (its back end in a process beside) and to
  `Robot.add_scan`, in turn, and which of the two goes first changes with each scan. The difference of each pair counts:
  its median is the overhead. CPU is that of the calling thread. As fast as the back ends can follow; the waits for that
  are not counted.
- Scan in to pose out: `Robot.add_scan` in real time, on a simulated robot with 360 beams at 10 Hz, without anything
  else; wall time.
- CPU: of the same drive, both processes together, all threads, as a share of one core. The start and the end of the
  robot do not count.
"""

import os
import time
from multiprocessing import active_children
from pathlib import Path

import common
import numpy as np
from worlds.yard import Yard

import fcslam
from fcslam.cli.play import PlaybackPace
from fcslam.lab.simulation.simulated_fleet import SimulationSettings, simulate_fleet
from fcslam.live.robot import LARGEST_BACKLOG
from fcslam.records import LaserScan
from fcslam.robot.backend_runner import backend_process
from fcslam.robot.frontend import RobotConfig, RobotFrontend
from fcslam.sources import open_source

QUANTILES = (50, 95, 99, 99.9, 100)
MILLISECONDS = {"": "", "scans": ",", "mean": ".3f", **{f"{q:g} %": ".3f" for q in QUANTILES}}
SPEED_M_S = 0.6
"""Of the simulated robot, about."""


def main() -> None:
    parser = common.options(__doc__ or "")
    parser.add_argument("--log", default="fr079")
    parser.add_argument("--seconds", type=float, default=60.0, help="of the drive in real time")
    chosen = parser.parse_args()
    folder = common.recordings(*common.slam_benchmark_files())
    report = common.Report(__file__, __doc__ or "", chosen)
    cpu_ms, wall_ms = overhead(common.log_path(folder, chosen.log))
    report.table(
        f"A scan of {chosen.log}, ms",
        MILLISECONDS,
        [
            row("bare front end, CPU", cpu_ms[:, 0]),
            row("Robot, CPU", cpu_ms[:, 1]),
            row("overhead, CPU", np.diff(cpu_ms)[:, 0]),
            row("overhead, wall", np.diff(wall_ms)[:, 0]),
        ],
    )
    latency_ms, share = drive(chosen.seconds)
    report.table("Scan in to pose out, ms, 360 beams at 10 Hz", MILLISECONDS, [row("wall", latency_ms)])
    report.say(f"One live robot takes {100.0 * share:.1f} % of a core, both processes together.")
    report.write()


def overhead(log: Path) -> tuple[np.ndarray, np.ndarray]:
    """CPU and wall milliseconds of each scan by the front end and by the class, each of shape (N, 2)."""
    scans = [record for record in open_source(log).records() if isinstance(record, LaserScan)]
    config = RobotConfig()
    with fcslam.Robot("class", scans[0].laser) as robot, backend_process("bare", config) as backend:
        bare = RobotFrontend("bare", config, backend)

        def by_class(scan: LaserScan) -> None:
            robot.add_scan(scan.ranges_m, scan.stamp, scan.T_odom_base)

        ways = bare.process, by_class
        timed = np.empty((len(scans), 2, 2))
        for number, scan in enumerate(scans):
            for way in (0, 1) if number % 2 else (1, 0):
                began = time.thread_time_ns(), time.perf_counter_ns()
                ways[way](scan)
                ended = time.thread_time_ns(), time.perf_counter_ns()
                timed[number, way] = np.subtract(ended, began) / 1e6
            robot.wait_for_room()
            while bare.packets.backlog > LARGEST_BACKLOG:
                time.sleep(0.01)
                bare.ready()
    return timed[..., 0], timed[..., 1]


def drive(seconds: float) -> tuple[np.ndarray, float]:
    """Wall milliseconds of each scan in real time, shape (N,), and the share of a core that the robot takes."""
    settings = SimulationSettings(robots=1, path_length_m=SPEED_M_S * seconds, camera=None)
    simulated = simulate_fleet(settings, 1, Yard()).robots[0]
    scans = list(simulated.scans())
    pace = PlaybackPace(1.0, time.monotonic, time.sleep)
    latency_ms = []
    with fcslam.Robot("live", simulated.lasers[0]) as robot:
        processes = os.getpid(), *(child.pid for child in active_children())
        before_s, began_s = sum(map(cpu_s, processes)), time.monotonic()
        for scan in scans:
            pace.wait(scan.stamp)
            at = time.perf_counter_ns()
            robot.add_scan(scan.ranges_m, scan.stamp, scan.T_odom_base)
            latency_ms.append((time.perf_counter_ns() - at) / 1e6)
        share = (sum(map(cpu_s, processes)) - before_s) / (time.monotonic() - began_s)
    return np.array(latency_ms), share


def cpu_s(process: int) -> float:
    """User and system time of a process, all threads, seconds."""
    fields = Path(f"/proc/{process}/stat").read_text(encoding="ascii").rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def row(what: str, ms: np.ndarray) -> tuple:
    return what, len(ms), ms.mean(), *np.percentile(ms, QUANTILES)


if __name__ == "__main__":
    main()
