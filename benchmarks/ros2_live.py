"""A live robot on ROS 2: scans lost, time from scan to pose, transforms, the map for a late subscriber, and CPU.

    python benchmarks/ros2_live.py --minutes 10 --speed 1 --speed 5

The robot is a real rclpy, as is the subscriber that comes late (`make ros-test` installs it; FCSLAM_RCLPY names another
Python with rclpy). Transforms are timed in this process, over Cyclone DDS.
"""

import json
import os
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import common

sys.path.insert(0, str(common.REPOSITORY))
from tests.ros.test_live_networks import for_player

RCLPY = Path(os.environ.get("FCSLAM_RCLPY", common.REPOSITORY / ".venv-ros" / "bin" / "python"))
PLAYER = common.REPOSITORY / "tests" / "ros" / "rclpy_player.py"
DOMAIN = 61
TICKS_PER_S = os.sysconf("SC_CLK_TCK")
COLUMNS = {
    "speed": ".0f", "scans played": ".0f", "scans mapped": ".0f",
    "50 %, ms": ".1f", "90 %, ms": ".1f", "99 %, ms": ".1f", "late map, s": ".2f",
    "transforms, Hz": ".1f", "jitter 95 %, ms": ".1f", "CPU, cores": ".3f", "apart, mm": ".3f",
}  # fmt: skip


def main():
    parser = common.options(__doc__.splitlines()[0])
    parser.add_argument("--minutes", type=float, default=10.0, help="of fr079, by its own clock")
    parser.add_argument("--speed", type=float, action="append", help="times real time; repeat it")
    chosen = parser.parse_args()
    log = common.log_path(common.recordings("slam-benchmark/fr079.clf.xz"), "fr079")
    if not RCLPY.exists():
        print(f"skipped: no rclpy at {RCLPY}; make ros-test installs it")
        return
    report = common.Report("benchmarks/ros2_live.py", __doc__.splitlines()[0], chosen)
    with tempfile.TemporaryDirectory() as folder:
        rows = drives(log, chosen.minutes, chosen.speed or [1.0, 5.0], Path(folder))
    report.table("One live robot, fr079", COLUMNS, rows)
    report.write()


def drives(log, minutes, speeds, folder):
    mounting = written(log, 60.0 * minutes, folder)
    common.run_fcslam("map", f"robot1={folder / 'bag.mcap'}", "-o", folder / "expected", "-q")
    return [drive(speed, mounting, folder) for speed in speeds]


def written(log, seconds, folder):
    """Write the first scans for the player and as a bag; returns where the laser sits."""
    import numpy as np

    from fcslam.records import LaserScan
    from fcslam.sources import open_source, write_bag

    scans = [record for record in open_source(log).records() if isinstance(record, LaserScan)]
    scans = [scan for scan in scans if scan.stamp < scans[0].stamp + seconds]
    laser = scans[0].laser
    ranges_m = (np.where(scan.ranges_m >= laser.max_range_m, np.inf, scan.ranges_m) for scan in scans)
    for_player(folder / "scans.npz", [replace(s, ranges_m=r) for s, r in zip(scans, ranges_m, strict=True)])
    write_bag(folder / "bag.mcap", scans)
    return laser.T_base_laser


def drive(speed, mounting, folder):
    """Play the scans at ``speed`` to a robot; returns the row of the report."""
    import numpy as np

    output = folder / f"run{speed:g}"
    environment = {
        **os.environ,
        "ROS_DOMAIN_ID": str(DOMAIN),
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
        "RMW_IMPLEMENTATION": "rmw_fastrtps_cpp",
    }
    command = [sys.executable, "-c", common._COMMAND, "robot", "ros2:/robot1", "-o", output, "-q"]
    command.append("--sensors=laser-pose=" + ",".join(map(str, mounting)))
    package = str(Path(common.fcslam.__file__).parents[1])
    arrivals = heard_transforms(environment)
    with (
        subprocess.Popen(list(map(str, command)), env={**environment, "PYTHONPATH": package}) as robot,
        subprocess.Popen(
            [str(RCLPY), str(PLAYER), str(folder / "scans.npz"), "/robot1", str(speed)],
            env=environment, stdout=subprocess.PIPE, text=True,
        ) as player,
    ):  # fmt: skip
        while not arrivals and player.poll() is None:
            time.sleep(0.1)
        began, spent = time.monotonic(), cpu_s(robot.pid)
        while player.poll() is None:
            time.sleep(0.2)
            now, used = time.monotonic(), cpu_s(robot.pid)
        if player.returncode:
            robot.kill()
            raise SystemExit("the player failed; its message is above")
        answer = json.loads(player.stdout.read().splitlines()[-1])
        robot.wait(300.0)
    gaps = np.diff([arrival for arrival in arrivals if arrival < now])
    live, expected = (np.loadtxt(run / "trajectories" / "robot1.tum") for run in (output, folder / "expected"))
    apart_mm = 1e3 * np.abs(live[:, 1:3] - expected[:, 1:3]).max() if len(live) == len(expected) else float("nan")
    return (
        speed, answer["played"], len(live), *answer["latency_ms"], answer["map_s"], 1.0 / np.mean(gaps),
        1e3 * np.quantile(np.abs(gaps - 0.05), 0.95), (used - spent) / (now - began), apart_mm,
    )  # fmt: skip


def heard_transforms(environment):
    """A list that grows by the time at which each transform arrives."""
    from fcslam.ros.network import Quality
    from fcslam.ros.ros2 import Ros2Network

    if not hasattr(heard_transforms, "network"):
        heard_transforms.network = Ros2Network(DOMAIN, environment)
        heard_transforms.arrivals = []
        heard_transforms.network.subscribe(
            "/tf", "tf2_msgs/TFMessage", Quality(True, False, 100),
            lambda *_: heard_transforms.arrivals.append(time.monotonic()),
        )  # fmt: skip
    heard_transforms.arrivals.clear()
    return heard_transforms.arrivals


def cpu_s(process):
    """User and system seconds of a process and its children so far."""
    total = 0.0
    for number in (process, *children(process)):
        try:
            fields = Path(f"/proc/{number}/stat").read_text(encoding="ascii").rpartition(")")[2].split()
        except OSError:  # it has ended
            continue
        total += (int(fields[11]) + int(fields[12])) / TICKS_PER_S
    return total


def children(process):
    found = " ".join(path.read_text(encoding="ascii") for path in Path(f"/proc/{process}/task").glob("*/children"))
    return [int(number) for number in found.split()]


if __name__ == "__main__":
    main()
