"""What grows as the map and the fleet grow: time a scan, a place and a solve, and memory.

    FCSLAM_DATA=/path/to/data python benchmarks/scaling.py

**Again and again**: one robot drives the intel recording 8 times without a break, stamps and odometry continued.
The recording ends 0.3 m from where it begins; between two rounds the odometry makes this step, by the relation of the
two poses in the first round's result. So the building stays the same while scans, keyscans and closures add up; "off
the first round" says how far the last round's scans lie from the same scans in the first. Without FCSLAM_DATA this part
is left out.

**One building, more robots**: 1 to 16 simulated robots of 60 m each in one building. **More buildings, more robots**:
the same, two robots in each building, and none may meet a robot of another one; here the map grows with the fleet.

Each case is a process of its own after a small warm-up drive. CPU is user and system of the process, all threads. A
scan is a robot's work, a place the cloud's: decode, match, verify, and solve where one is due. "Quick solve" is the
cloud's solve on the way, "robust solve" the one at the end, "end" all that the cloud does at the end of the run (after
the first round of a longer run it takes all packets in again before). Memory is the peak resident set; recordings are
streamed in the first part and simulated as they are needed in the others.
"""

import heapq
import itertools
import os
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field, replace
from multiprocessing import get_context
from pathlib import Path
from typing import Any
from unittest.mock import patch

import common

ROUNDS = 8
ROBOTS = (1, 2, 4, 8, 16)
ROBOTS_A_BUILDING = 2
BETWEEN_ROUNDS_S = 1.0
SEED = 1
SCAN = {"a scan: mean, ms": ".2f", "a scan: 99 %, ms": ".1f", "a scan: max, ms": ".0f"}
PLACE = {"a place: mean, ms": ".1f", "a place: 99 %, ms": ".0f", "a place: max, ms": ".0f"}
END = {"robust solve, s": ".2f", "end, s": ".2f"}
ROUND = {"rounds": "", "scans": ",", "keyscans": ",", "closures": ",", **SCAN, "robot's solves": "",
         "a solve: mean, ms": ".0f", **END, "peak, MB": ".0f", "off the first round: median, m": ".3f",
         "99 %, m": ".3f", "max, m": ".3f"}  # fmt: skip
FLEET = {"robots": "", "buildings": "", "maps": "", "scans": ",", "places": ",", **SCAN, **PLACE, "quick solves": "",
         "a quick solve: mean, ms": ".0f", **END, "between robots: accepted": ",", "peak, MB": ".0f"}  # fmt: skip


def main() -> None:
    parser = common.options(__doc__)
    parser.add_argument("--rounds", type=int, default=ROUNDS, help="how often the recording is driven")
    parser.add_argument("--robots", nargs="+", type=int, default=ROBOTS, help="sizes of the simulated fleets")
    chosen = parser.parse_args()
    report = common.Report(__file__, __doc__, chosen)
    rounds = []
    if os.environ.get("FCSLAM_DATA"):
        folder = common.recordings("slam-benchmark/intel.clf.xz")
        rounds = alone(drive_again, common.log_path(folder, "intel"), chosen.rounds)
        report.table("Again and again", ROUND, rounds)
    one = [alone(drive_fleet, robots, 1) for robots in chosen.robots]
    report.table("One building, more robots", FLEET, one)
    several = [alone(drive_fleet, n, -(-n // ROBOTS_A_BUILDING)) for n in chosen.robots if n > ROBOTS_A_BUILDING]
    report.table("More buildings, more robots", FLEET, several)
    report.picture("What grows", draw(rounds, one, several))
    report.write()


def alone(case: Callable[..., Any], *arguments: object) -> Any:
    """The result of ``case`` in a fresh process."""
    with get_context("spawn").Pool(1) as pool:
        return pool.apply(case, arguments)


@dataclass
class Stopwatch:
    """CPU seconds of each call of what is being watched."""

    spent_s: list[float] = field(default_factory=list)

    @contextmanager
    def __call__(self) -> Iterator[None]:
        began = time.process_time()
        yield
        self.spent_s.append(time.process_time() - began)

    def watch(self, function: Callable[..., Any]) -> Callable[..., Any]:
        def watched(*arguments: Any, **options: Any) -> Any:
            with self():
                return function(*arguments, **options)

        return watched


@dataclass
class Watches:
    """What a mission spends, part by part."""

    scan: Stopwatch = field(default_factory=Stopwatch)
    place: Stopwatch = field(default_factory=Stopwatch)
    robot_solve: Stopwatch = field(default_factory=Stopwatch)
    quick: Stopwatch = field(default_factory=Stopwatch)
    robust: Stopwatch = field(default_factory=Stopwatch)
    end: Stopwatch = field(default_factory=Stopwatch)

    @contextmanager
    def on(self) -> Iterator["Watches"]:
        """Count what runs inside."""
        from fcslam.cloud import decisions
        from fcslam.cloud.joint_graph import JointGraph
        from fcslam.lidar import backend

        with ExitStack() as stack:
            for owner, name, watch in (
                (JointGraph, "optimize", self.quick),
                (decisions, "reevaluate", self.robust),
                (backend, "optimize", self.robot_solve),
            ):
                stack.enter_context(patch.object(owner, name, watch.watch(getattr(owner, name))))
            yield self


def drive_again(log: Path, rounds: int) -> list[tuple]:
    """One row after 1, 2, 4 ... rounds of the recording."""
    from fcslam.cloud.cloud import Cloud
    from fcslam.mission.mission import MissionConfig
    from fcslam.robot.frontend import RobotFrontend
    from fcslam.sources import open_source

    warm_up()
    config = MissionConfig()
    robot, cloud, source = RobotFrontend("robot", config.robot), Cloud(config.fleet, config.seed), open_source(log)
    repeated, rows = Repeated(), []
    with Watches().on() as watches:
        for number in range(1, rounds + 1):
            since = len(watches.scan.spent_s), len(watches.robot_solve.spent_s)
            scans = repeated.scans(source.records())
            send(packets(robot, scans, watches, is_all=number == rounds), cloud, watches)
            if number == 1 or number & (number - 1) == 0 or number == rounds:
                with watches.end():
                    result = cloud.finalize()
                poses = scan_poses(robot, result)
                if number == 1:
                    repeated.back = back_to_the_start(poses)
                rows.append((number, *round_row(watches, since, result, poses, number)))
            repeated.end_round()
    return rows


class Repeated:
    """A recording's scans round after round, with stamps and odometry that go on."""

    def __init__(self) -> None:
        self.back: Any = None
        """T_last_first: where the first pose of a round lies, seen from its last."""
        self._shift_s, self._T_odom_start = 0.0, None
        self._first: Any = None
        self._last: Any = None

    def scans(self, records: Iterable[Any]) -> Iterator[Any]:
        from fcslam.geometry import se2
        from fcslam.records import LaserScan

        self._first = None
        for record in records:
            if isinstance(record, LaserScan):
                first = self._first = self._first or record
                pose = record.T_odom_base
                if self._T_odom_start is not None:
                    pose = se2.compose(self._T_odom_start, se2.between(first.T_odom_base, pose))
                self._last = replace(record, stamp=record.stamp + self._shift_s, T_odom_base=pose)
                yield self._last

    def end_round(self) -> None:
        """The next round starts where the odometry says that the first pose is."""
        from fcslam.geometry import se2

        self._T_odom_start = se2.compose(self._last.T_odom_base, self.back)
        self._shift_s = self._last.stamp + BETWEEN_ROUNDS_S - self._first.stamp


def scan_poses(robot: Any, result: Any) -> Any:
    """T_map_base of every scan, shape (N, 3)."""
    from fcslam.geometry import se2

    track = robot.scan_poses
    return se2.compose(result.robots[0].T_map_base[track.keyscans], track.T_keyscan_base)


def back_to_the_start(poses: Any) -> Any:
    from fcslam.geometry import se2

    return se2.between(poses[-1], poses[0])


def round_row(watches: Watches, since: tuple[int, int], result: Any, poses: Any, rounds: int) -> tuple:
    """Times are those of the latest round; poses are compared with the same scan's in the first."""
    import numpy as np

    of_rounds = poses.reshape(rounds, -1, 3)
    off = np.hypot(*(of_rounds[-1] - of_rounds[0])[:, :2].T) if rounds > 1 else np.full(1, np.nan)
    solves_ms = 1e3 * np.array(watches.robot_solve.spent_s[since[1] :])
    scans = milliseconds(watches.scan.spent_s[since[0] :])
    closures = len(result.closures)
    solves = (len(solves_ms), solves_ms.mean(), watches.robust.spent_s[-1], watches.end.spent_s[-1])
    keyscans = len(result.robots[0].keyscans)
    return len(poses), keyscans, closures, *scans, *solves, peak_mb(), *np.percentile(off, (50, 99, 100))


def drive_fleet(robots: int, buildings: int) -> tuple:
    """A simulated fleet, spread evenly over buildings."""
    import numpy as np

    from fcslam.cloud.cloud import Cloud
    from fcslam.mission.mission import MissionConfig
    from fcslam.records import ClosureStatus
    from fcslam.robot.frontend import RobotFrontend

    warm_up()
    config = MissionConfig()
    sizes = [robots // buildings + (building < robots % buildings) for building in range(buildings)]
    recordings = [recording for building, size in enumerate(sizes) for recording in simulated(building, size)]
    frontends = [RobotFrontend(recording.name, config.robot) for recording in recordings]
    cloud = Cloud(config.fleet, config.seed)
    with Watches().on() as watches:
        streams = [packets(f, r.scans(), watches) for f, r in zip(frontends, recordings, strict=True)]
        send(heapq.merge(*streams, key=lambda packet: packet.order), cloud, watches)
        with watches.end():
            result = cloud.finalize()
    between = [c.status for c in result.closures if c.i.robot != c.j.robot]
    quick_ms = 1e3 * np.array(watches.quick.spent_s) if watches.quick.spent_s else np.full(1, np.nan)
    scans, places = watches.scan.spent_s, watches.place.spent_s
    solves = (len(watches.quick.spent_s), quick_ms.mean(), watches.robust.spent_s[-1], watches.end.spent_s[-1])
    maps = len({robot.map_index for robot in result.robots})
    return (robots, buildings, maps, len(scans), len(places), *milliseconds(scans), *milliseconds(places), *solves,
            between.count(ClosureStatus.ACCEPTED), peak_mb())  # fmt: skip


def simulated(building: int, robots: int, path_length_m: float = 60.0) -> Iterator[Any]:
    """Recordings of robots in a building of their own."""
    from fcslam.lab.simulation.noise import LidarSettings
    from fcslam.lab.simulation.simulated_fleet import SimulationSettings, simulate_fleet

    settings = SimulationSettings(
        robots=robots, path_length_m=path_length_m, camera=None, lidar=LidarSettings(rate_hz=5.0)
    )
    for robot in simulate_fleet(settings, 1000 * SEED + building).robots:
        yield replace(robot, name=f"building_{building + 1}_{robot.name}")


def warm_up() -> None:
    """Load or compile every kernel of robot and cloud."""
    from fcslam.cloud.cloud import Cloud
    from fcslam.cloud.report import fuse_members
    from fcslam.mission.mission import MissionConfig
    from fcslam.robot.frontend import RobotFrontend

    config, watches = MissionConfig(), Watches()
    streams = [packets(RobotFrontend(r.name, config.robot), r.scans(), watches) for r in simulated(99, 2, 20.0)]
    cloud = Cloud(config.fleet, config.seed)
    send(itertools.chain(*streams), cloud, watches)
    fuse_members(cloud.finalize().robots, config.map)


def packets(robot: Any, scans: Iterable[Any], watches: Watches, is_all: bool = True) -> Iterator[Any]:
    """What a robot sends for ``scans``; submaps that are open at their end stay open if that is not all."""
    for scan in scans:
        with watches.scan():
            sent = robot.process(scan)
        yield from sent
    if is_all:
        yield from robot.finish()


def send(stream: Iterable[Any], cloud: Any, watches: Watches) -> None:
    from fcslam.records import Place
    from fcslam.wire.packets import encode

    for packet in stream:
        data = encode(packet)
        with watches.place() if isinstance(packet.body, Place) else ExitStack():
            cloud.receive(data)


def milliseconds(spent_s: list[float]) -> tuple[float, float, float]:
    """Mean, 99th percentile and maximum."""
    import numpy as np

    ms = 1e3 * np.array(spent_s)
    return float(ms.mean()), float(np.percentile(ms, 99)), float(ms.max())


def peak_mb() -> float:
    """Peak resident set of this process alone: unlike ru_maxrss it does not begin with what its parent held."""
    lines = Path("/proc/self/status").read_text(encoding="ascii").splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("VmHWM:")) * 1024 / 1e6


def draw(rounds: list[tuple], one: list[tuple], several: list[tuple]) -> Any:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10.0, 6.0), layout="constrained")
    top, bottom = figure.subplots(2, 3)
    again = {"one robot": (ROUND, rounds)}
    plot(top, "rounds of intel", again, ("a scan: mean, ms", "robust solve, s", "peak, MB"))
    fleets = {"one building": (FLEET, one), "two robots a building": (FLEET, several)}
    plot(bottom, "simulated robots of 60 m", fleets, ("a place: mean, ms", "robust solve, s", "peak, MB"))
    bottom[0].legend(fontsize=8)
    return figure


def plot(row: Any, size: str, lines: dict[str, tuple[dict[str, str], list[tuple]]], columns: tuple[str, ...]) -> None:
    """One diagram for each of ``columns`` over the first one."""
    for axes, column in zip(row, columns, strict=True):
        for label, (names, rows) in lines.items():
            axes.plot([row[0] for row in rows], [row[list(names).index(column)] for row in rows], "o-", label=label)
        axes.set(xlabel=size, title=column)
        axes.set_ylim(bottom=0.0)
        axes.title.set_fontsize(10)


if __name__ == "__main__":
    main()
