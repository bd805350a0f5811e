"""Twelve hours of a service and five robots in fast motion: memory, files and database, hour by hour.

    python benchmarks/soak.py [--hours 12] [--robots 5] [--rate 5] [--minutes 60] [--patrol 15]

Simulated robots (LiDAR, 180 beams) map one building with `fcslam serve`, each in a process of its own, up to 60 times
as fast as in reality. In the first hour, each drives 40 m and four patrols: 5 m back and forth. In every further hour
it drives one patrol. Then it stands, as between two tasks; its LiDAR always scans. After every simulated minute, all of
its connections break.

An hour ends when each robot has drawn its map and every packet has had its effect. Then the script reads the memory of
each process: resident, without what it shares with a process that it forked, and whatever other programs run. It counts
open files, and reads the size of the mission's database. The service's worker and the robots' back ends are processes
of their own. A mission keeps all packets; the table shows what the database holds beside their bytes, and its
write-ahead log. The report is written anew after each hour.

With `--patrol 0`, the robots stand from the second hour on: then nothing at all may grow, as no map does.

Passed: from the first hour to the last, no process grows by more than 5 %, none has more open files by more than
three, and the database holds at most 500 bytes more for each further packet beside the packet itself.
"""

import asyncio
import multiprocessing
import sqlite3
import sys
import tempfile
import threading
import time
from collections.abc import Mapping, Sequence
from contextlib import ExitStack, closing, suppress
from pathlib import Path
from typing import Any, NamedTuple

import common
import numpy as np
from processes import PATIENCE_S, cloud, yes

import fcslam
from fcslam.service.missions import FIRST

MINUTE_S, LEAST_WALL_S = 60.0, 1.0
"""A simulated minute takes at least a second."""
PATH_M, FIRST_PATROLS = 40.0, 4
NOISE_M = 0.01
MOST_GROWTH, MORE_FILES, MOST_BESIDE = 0.05, 3, 500.0
KINDS = ("service", "worker", "robots", "back ends")
HOURS = {"hour": "", **{f"{kind}, MB": ".1f" for kind in KINDS}, **{f"{kind}, files": "" for kind in KINDS},
         "scans": ",", "connections": ",", "packets": ",", "packets, kB": ",.0f", "beside them, kB": ",.0f",
         "log, kB": ",.0f", "s": ",.0f"}  # fmt: skip
GROWTH = {"process": "", "first hour, MB": ".1f", "last hour, MB": ".1f", "growth, %": ".2f", "files": "",
          "files, last hour": "", "passed": ""}  # fmt: skip


class Drive(NamedTuple):
    """What a robot senses on its way."""

    laser: fcslam.LaserModel
    ranges_m: np.ndarray
    """Shape (N, beams)."""
    T_odom_base: np.ndarray
    """Shape (N, 3)."""


class Link:
    """A way to the service whose connections break when told; runs in a thread of its own."""

    def __init__(self, to_port: int) -> None:
        self.connections = 0
        self._to_port = to_port
        self._open: set[asyncio.StreamWriter] = set()
        self._loop = asyncio.new_event_loop()
        threading.Thread(target=self._loop.run_forever, daemon=True).start()
        starting = asyncio.start_server(self._serve, "127.0.0.1", 0)
        server = asyncio.run_coroutine_threadsafe(starting, self._loop).result()
        self.port: int = server.sockets[0].getsockname()[1]

    def cut(self) -> None:
        self._loop.call_soon_threadsafe(lambda: [writer.transport.abort() for writer in self._open])

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        there, back = await asyncio.open_connection("127.0.0.1", self._to_port)
        self.connections += 1
        self._open |= {writer, back}
        await asyncio.gather(self._pass(reader, back), self._pass(there, writer))
        self._open -= {writer, back}

    async def _pass(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        with suppress(OSError):
            while data := await reader.read(1 << 16):
                writer.write(data)
                await writer.drain()
        writer.close()


def main() -> None:
    parser = common.options(__doc__)
    parser.add_argument("--hours", type=int, default=12)
    parser.add_argument("--robots", type=int, default=5)
    parser.add_argument("--rate", type=float, default=5.0, help="of the LiDARs, Hz")
    parser.add_argument("--minutes", type=int, default=60, help="of an hour, for a short try")
    parser.add_argument("--patrol", type=float, default=15.0, help="seconds that a robot drives there, and back")
    chosen = parser.parse_args()
    spawning = multiprocessing.get_context("spawn")
    began, rows, processes = time.perf_counter(), [], []
    minutes = spawning.Array("i", chosen.robots)
    hour = spawning.Barrier(chosen.robots + 1)
    with tempfile.TemporaryDirectory() as folder, cloud(Path(folder)) as (server, port), ExitStack() as stack:
        links = [Link(port) for _ in range(chosen.robots)]
        robots = [
            spawning.Process(target=run_robot, args=(number, drive, chosen, link.port, folder, minutes, hour))
            for number, (drive, link) in enumerate(zip(drives(chosen), links, strict=True))
        ]  # fmt: skip
        for robot in robots:
            robot.start()
            stack.callback(robot.kill)
        for number in range(1, chosen.hours + 1):
            watch(robots, links, minutes, hour)
            pids = {"service": server.process.pid, **{f"robot {k + 1}": each.pid for k, each in enumerate(robots)}}
            processes.append(measured(port, pids))
            rows.append((
                number, *sums(processes[-1]), number * scans_an_hour(chosen) * chosen.robots,
                sum(link.connections for link in links), *stored(Path(folder)), time.perf_counter() - began,
            ))  # fmt: skip
            print(*rows[-1], flush=True)
            is_good = write(chosen, rows, processes)
            hour.wait(PATIENCE_S)
    if not is_good:
        sys.exit("soak: something grows")


def drives(chosen: Any) -> list[Drive]:
    """What each robot senses on its way through the building."""
    from fcslam.lab.simulation.noise import LidarSettings
    from fcslam.lab.simulation.simulated_fleet import SimulationSettings, simulate_fleet

    lidar = LidarSettings(beams=180, rate_hz=chosen.rate)
    fleet = simulate_fleet(
        SimulationSettings(robots=chosen.robots, path_length_m=PATH_M, lidar=lidar, camera=None), seed=1
    )
    return [
        Drive(robot.lasers[0], np.array([scan.ranges_m for scan in robot.scans()]), np.array(robot.T_odom_base))
        for robot in fleet.robots
    ]


def scans_an_hour(chosen: Any) -> int:
    return int(chosen.minutes * MINUTE_S * chosen.rate)


def run_robot(number: int, drive: Drive, chosen: Any, port: int, folder: str, minutes: Any, hour: Any) -> None:
    """Drive for hours."""
    rng, end = np.random.default_rng(number), len(drive.ranges_m) - 1
    away = range(end, max(0, end - round(chosen.patrol * chosen.rate)), -1)
    name = f"robot_{number + 1}"
    with fcslam.Robot(name, drive.laser, server=f"http://127.0.0.1:{port}", state=Path(folder) / name) as robot:
        began = time.monotonic()
        for count in range(chosen.hours * scans_an_hour(chosen)):
            begun, step = divmod(count, scans_an_hour(chosen))
            patrol = (*away, *reversed(away))
            way = patrol if begun else (*range(end + 1), *FIRST_PATROLS * patrol)
            index = way[step] if step < len(way) else end
            noise = rng.normal(0.0, NOISE_M, drive.ranges_m.shape[1])
            robot.add_scan(drive.ranges_m[index] + noise, 1000.0 + count / chosen.rate, drive.T_odom_base[index])
            robot.wait_for_room()
            minute = int((count + 1) / chosen.rate // MINUTE_S)
            if minute > minutes[number]:
                time.sleep(max(0.0, began + LEAST_WALL_S - time.monotonic()))
                began, minutes[number] = time.monotonic(), minute
            if step == scans_an_hour(chosen) - 1:
                robot.own_map()  # waits for the back end
                robot.map()
                time.sleep(1.0)
                while robot.status().waiting.packets:
                    time.sleep(0.1)
                hour.wait(PATIENCE_S)  # the measurement begins
                hour.wait(PATIENCE_S)


def watch(robots: Sequence[Any], links: Sequence[Link], minutes: Any, hour: Any) -> None:
    """Cut a robot's connections after each of its minutes, until all have done their hour."""
    cut = list(minutes)
    while hour.n_waiting < len(robots):
        if any(robot.exitcode is not None for robot in robots):
            sys.exit("a robot ended")
        for number, (before, now) in enumerate(zip(cut, minutes, strict=True)):
            if now > before:
                links[number].cut()
        cut = list(minutes)
        time.sleep(0.01)
    hour.wait(PATIENCE_S)


def settle(port: int, service: int) -> None:
    """Wait until every packet has had its effect, and the worker runs no task in a copy of itself."""
    import httpx

    until = time.monotonic() + PATIENCE_S
    while httpx.get(f"http://127.0.0.1:{port}/readyz").json().get("backlog") != 0 or len(children(service)) > 1:
        if time.monotonic() > until:
            sys.exit("the service does not catch up")
        time.sleep(0.2)


def measured(port: int, pids: Mapping[str, int]) -> dict[str, tuple[float, int]]:
    """Memory, MB, and open files of each process, and those of the ones that it started together."""
    while True:
        settle(port, pids["service"])
        found = usages(pids)
        if len(children(pids["service"])) == 1:  # no copy of the worker began meanwhile
            return found


def usages(pids: Mapping[str, int]) -> dict[str, tuple[float, int]]:
    """As ``measured``, at this moment."""
    found = {}
    for name, pid in pids.items():
        found[name] = usage(pid)
        used = [usage(child) for child in children(pid)]
        below = "worker" if name == "service" else f"{name}, back end"
        found[below] = sum(mb for mb, _ in used), sum(files for _, files in used)
    return found


def children(pid: int) -> list[int]:
    """All processes below this one."""
    files = Path(f"/proc/{pid}/task").glob("*/children")
    direct = [int(child) for file in files for child in file.read_text(encoding="ascii").split()]
    return direct + [below for child in direct for below in children(child)]


def usage(pid: int) -> tuple[float, int]:
    lines = Path(f"/proc/{pid}/smaps_rollup").read_text(encoding="ascii").splitlines()[1:]
    kb = {key: int(value.split()[0]) for key, value in (line.split(":") for line in lines)}
    resident = kb["Rss"] - kb["Anonymous"] + kb["Pss_Anon"]
    return resident * 1024 / 1e6, len(list(Path(f"/proc/{pid}/fd").iterdir()))


def sums(found: Mapping[str, tuple[float, int]]) -> list[float]:
    """Memory of each kind of process, then files of each."""
    kinds = {kind: [] for kind in KINDS}
    for name, used in found.items():
        kinds["back ends" if name.endswith("back end") else name if name in KINDS else "robots"].append(used)
    return [sum(used[column] for used in some) for column in (0, 1) for some in kinds.values()]


def stored(folder: Path) -> tuple[int, float, float, float]:
    """Packets, their kB, the rest of the database and its log, kB."""
    path = folder / "cloud" / "missions" / FIRST / "mission.sqlite"
    with closing(sqlite3.connect(f"{path.as_uri()}?mode=ro", uri=True)) as database:
        packets, size = database.execute("SELECT count(*), sum(length(data)) FROM packets").fetchone()
        whole = database.execute("PRAGMA page_count").fetchone()[0] * database.execute("PRAGMA page_size").fetchone()[0]
    log = path.with_name("mission.sqlite-wal").stat().st_size
    return packets, size / 1e3, (whole - size) / 1e3, log / 1e3


def write(chosen: Any, rows: Sequence[tuple], processes: Sequence[Mapping[str, tuple[float, int]]]) -> bool:
    """The report of the hours so far, and whether they passed."""
    report = common.Report("soak" if chosen.patrol else "soak_standing", __doc__, chosen)
    report.say(
        f"{len(rows)} of {chosen.hours} hours of {chosen.minutes} min, {chosen.robots} robots, "
        f"{chosen.rate:g} scans a second, patrols of {chosen.patrol:g} s."
    )
    report.table("Hours", HOURS, rows)
    growth = []
    for name, (first, files) in processes[0].items():
        last, files_last = processes[-1][name]
        grown = last / first - 1.0
        passed = grown <= MOST_GROWTH and files_last <= files + MORE_FILES
        growth.append((name, first, last, 100.0 * grown, files, files_last, yes(passed)))
    report.table("Growth of each process", GROWTH, growth)
    (packets, rest), (packets_last, rest_last) = ((row[-5], row[-3]) for row in (rows[0], rows[-1]))
    beside = 1e3 * (rest_last - rest) / max(1, packets_last - packets)
    report.say(f"Each further packet takes {beside:.0f} bytes of the database beside its own.")
    report.write()
    return beside <= MOST_BESIDE and all(row[-1] == "yes" for row in growth)


if __name__ == "__main__":
    main()
