"""Many robots at once, at real time, on one service: how long it takes to take a packet in, and until it has effect.

    python benchmarks/live.py [--robots 20] [--path 30] [--page] [--load 8]

A simulated fleet (LiDAR, 360 beams at 10 Hz) is run through the robots' front ends beforehand. Then each robot's
packets go to `fcslam serve` at the moments at which the robot had them, over a connection of its own, from one process
that does nothing else. The simulated LiDARs all turn in step, real ones do not: each robot begins at a moment of its
own within the first second, or, with `--in-step`, all at once. A building has at most 25 robots; more robots are in
more buildings.

"Taken in": from sending a request to the answer that says that its packets are on disk. "In effect": from that answer
until the process in which the fleet lives has matched, verified and solved what they bring, and a correction lies
ready; seen by looking into the mission's file 20 times a second, which keeps nobody waiting. "Correction at the robot":
from sending a place until the answer to the first request that the robot sends after the place has had effect. A robot
that has nothing left to send asks once a second. "In the live map": from the answer until the run folder that the page
shows has what the request brought. "Newest drive in the live map" is that of the last request of all. `--load` keeps so
many other processes busy meanwhile. Memory: the most that the
service and its worker held (VmHWM, added up). Server, worker and sender share the machine.
CPU: user and system of each, all threads; the sender's is that of the robots' side, which a fleet has elsewhere.
"""

import asyncio
import gc
import os
import shutil
import sqlite3
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import common
import httpx
import numpy as np
from faults import cloud, finalize

from fcslam.lab.simulation.simulated_fleet import SimulatedRobot, SimulationSettings, simulate_fleet
from fcslam.mission.mission import MissionConfig
from fcslam.records import Correction
from fcslam.robot.frontend import RobotFrontend
from fcslam.robot.sender import SEND_INTERVAL_S
from fcslam.service.missions import FIRST
from fcslam.wire.batches import AGENT_HEADER, CORRECTION_HEADER, MEDIA_TYPE, read_batch, write_batch
from fcslam.wire.packets import decode, encode

ROBOTS, PATH_M = 20, 30.0
ROBOTS_PER_BUILDING = 25
LOOK_EVERY_S = 0.05
EFFECTLESS_S = 600.0
"""If packets have had no effect for so long they will have none."""
COLUMNS = {"": "s", "requests": ",d", "median": ".1f", "95 %": ".1f", "99 %": ".1f", "most": ".1f"}


class Due(NamedTuple):
    """What a robot has to send at a moment."""

    at_s: float
    """Since the recording began."""
    packets: tuple[bytes, ...]
    has_place: bool


class Sent(NamedTuple):
    """A request that was answered."""

    robot: str
    asked_s: float
    answered_s: float
    packets: int
    has_place: bool


class Look(NamedTuple):
    """What was in the mission's file."""

    at_s: float
    stored: int
    applied: int
    drawn: int
    """In the live run folder, which the page shows."""


def main() -> None:
    parser = common.options(__doc__ or "")
    parser.add_argument("--robots", type=int, default=ROBOTS)
    parser.add_argument("--path", type=float, default=PATH_M, help="of each robot, m")
    parser.add_argument("--seed", type=int, default=1, help="of the fleet")
    parser.add_argument("--page", action="store_true", help="a browser shows the page meanwhile (make browser-test)")
    parser.add_argument("--load", type=int, default=0, help="other processes that compute all the time")
    parser.add_argument("--in-step", action="store_true", help="all robots begin in the same millisecond")
    chosen = parser.parse_args()
    report = common.Report(__file__, __doc__ or "", chosen)
    begins_s = np.random.default_rng(chosen.seed).uniform(0.0, 0.0 if chosen.in_step else 1.0, chosen.robots)
    robots = _simulated(chosen.robots, chosen.path, chosen.seed)
    agendas = {robot.name: _agenda(robot, begin_s) for robot, begin_s in zip(robots, begins_s, strict=True)}
    gc.collect()
    gc.freeze()  # the sender's own pauses are not the service's
    with tempfile.TemporaryDirectory() as place, cloud(Path(place)) as (server, port), ExitStack() as opened:
        if chosen.page:
            opened.enter_context(_page(f"http://127.0.0.1:{port}/"))
        opened.enter_context(_load(chosen.load))
        began_s = time.process_time()
        mission = Path(place) / "cloud" / "missions" / FIRST / "mission.sqlite"
        answers, looks = asyncio.run(_play(agendas, f"http://127.0.0.1:{port}", mission))
        sender_s = time.process_time() - began_s
        worker = _children(server.process.pid)
        memory_mb = sum(_peak_mb(pid) for pid in (server.process.pid, *worker))
        cpu_s = _cpu_s(server.process.pid), sum(_cpu_s(pid) for pid in worker), sender_s
        run = finalize(port)
        closures, maps = common.metrics(run)["inter_robot_closures_accepted"], common.metrics(run)["maps"]
    sent = [each for each in answers if each.packets]
    places = [each for each in sent if each.has_place]
    report.table(
        "Milliseconds",
        COLUMNS,
        [
            ("taken in", len(sent), *_spread([each.answered_s - each.asked_s for each in sent])),
            ("in effect, all", len(sent), *_spread(_effect(sent, looks))),
            ("in effect, places", len(places), *_spread(_effect(places, looks))),
            ("in the live map", len(sent), *_spread(drawn := _effect(sent, looks, lambda look: look.drawn))),
            ("correction at the robot", len(places), *_spread(_corrected(places, answers, looks))),
        ],
    )
    packets = sum(len(due.packets) for agenda in agendas.values() for due in agenda)
    duration_s = max(agenda[-1].at_s for agenda in agendas.values())
    size = sum(len(data) for agenda in agendas.values() for due in agenda for data in due.packets)
    report.say(
        f"{chosen.robots} robots for {duration_s:.0f} s: {packets:,} packets, {size / 1e6:.1f} MB, "
        f"{size / 1e3 / duration_s / chosen.robots:.2f} kB/s a robot; {memory_mb:,.0f} MB; "
        f"CPU {cpu_s[0]:.0f} s of the service, {cpu_s[1]:.0f} s of its worker, {cpu_s[2]:.0f} s of the sender; "
        f"{closures:.0f} accepted closures between robots, {maps:.0f} map(s) in the end. Newest drive in the live map: "
        f"after {drawn[-1]:.1f} s. Load average: {os.getloadavg()[0]:.1f}."
    )
    report.write()


@contextmanager
def _load(processes: int) -> Iterator[None]:
    """Processes that compute, as others on a shared machine."""
    busy = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(processes)]
    try:
        yield
    finally:
        for process in busy:
            process.kill()
            process.wait()


@contextmanager
def _page(address: str) -> Iterator[None]:
    """Chromium shows the page."""
    command = [shutil.which("chromium") or sys.exit("needs Chromium; make browser-test"), "--headless", "--no-sandbox",
               "--disable-gpu", "--remote-debugging-port=0", "--window-size=1200,900", address]  # fmt: skip
    with (
        tempfile.TemporaryDirectory() as profile,
        subprocess.Popen(
            [*command, f"--user-data-dir={profile}"], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        ) as browser,
    ):
        try:
            yield
        finally:
            browser.terminate()


def _simulated(count: int, path_m: float, seed: int) -> list[SimulatedRobot]:
    """Robots, spread evenly over as few buildings as hold them."""
    buildings = -(-count // ROBOTS_PER_BUILDING)
    robots: list[SimulatedRobot] = []
    for building in range(buildings):
        size = count // buildings + (building < count % buildings)
        settings = SimulationSettings(robots=size, path_length_m=path_m, camera=None)
        fleet = simulate_fleet(settings, seed + building).robots
        robots += [replace(robot, name=f"building_{building + 1}_{robot.name}") for robot in fleet]
    return robots


def _agenda(robot: SimulatedRobot, begin_s: float) -> list[Due]:
    """What this robot sends, and when, if it begins at this time."""
    front = RobotFrontend(robot.name, MissionConfig().robot)
    agenda, began = [], None
    scans = list(robot.scans())
    for scan in scans:
        began = scan.stamp if began is None else began
        agenda.append(_due(begin_s + scan.stamp - began, front.process(scan)))
    agenda.append(_due(begin_s + scans[-1].stamp - began, front.finish()))
    return [due for due in agenda if due.packets]


def _due(at_s: float, packets: Sequence[object]) -> Due:
    return Due(
        at_s, tuple(encode(packet) for packet in packets), any(type(p.body).__name__ == "Place" for p in packets)
    )


async def _play(agendas: dict[str, list[Due]], url: str, mission: Path) -> tuple[list[Sent], list[Look]]:
    sent: list[Sent] = []
    looks: list[Look] = []
    began = time.perf_counter()
    all_sent, done = asyncio.Barrier(len(agendas) + 1), asyncio.Event()
    async with asyncio.TaskGroup() as group:
        watching = group.create_task(_watch(mission, looks))
        for name, agenda in agendas.items():
            group.create_task(_robot(name, agenda, url, began, sent, all_sent, done))
        await all_sent.wait()
        end = time.perf_counter()
        while not (looks and looks[-1].at_s > end and looks[-1].drawn >= looks[-1].stored):
            if time.perf_counter() - end > EFFECTLESS_S:
                raise SystemExit("live: the service has not caught up")
            await asyncio.sleep(LOOK_EVERY_S)
        watching.cancel()
        done.set()
    return sorted(sent, key=lambda each: each.answered_s), looks


async def _robot(
    name: str, agenda: list[Due], url: str, began: float, sent: list[Sent], all_sent: asyncio.Barrier,
    done: asyncio.Event,
) -> None:  # fmt: skip
    headers = {"Content-Type": MEDIA_TYPE, AGENT_HEADER: name.encode().hex()[:32]}
    version = -1
    async with httpx.AsyncClient(base_url=url, headers=headers, timeout=60.0, trust_env=False) as client:

        async def send(due: Due) -> None:
            nonlocal version
            asked, known = time.perf_counter(), {CORRECTION_HEADER: str(version)}
            path, content = f"/api/v1/robots/{name}/packets", write_batch(due.packets)
            try:
                answer = await client.post(path, content=content, headers=known)
            except (httpx.ReadError, httpx.RemoteProtocolError):  # the service closed an idle connection: robots retry
                answer = await client.post(path, content=content, headers=known)
            answer.raise_for_status()
            sent.append(Sent(name, asked, time.perf_counter(), len(due.packets), due.has_place))
            news = [decode(data).body for data in read_batch(answer.content)]
            version = max([version, *(body.version for body in news if isinstance(body, Correction))])

        for due in agenda:
            await asyncio.sleep(max(0.0, began + due.at_s - time.perf_counter()))
            await send(due)
        waiting = asyncio.create_task(all_sent.wait())
        is_last = False
        while not is_last:
            is_last = done.is_set()
            await send(Due(agenda[-1].at_s, (), False))
            if not is_last:
                await asyncio.wait([asyncio.create_task(done.wait())], timeout=SEND_INTERVAL_S)
        await waiting


async def _watch(mission: Path, looks: list[Look]) -> None:
    link, drawn, shown = mission.parent / "live", 0, None
    with closing(sqlite3.connect(f"{mission.as_uri()}?mode=ro", uri=True)) as database:
        while True:
            if link.exists() and link.readlink() != shown:
                shown = link.readlink()
                drawn = int(common.metrics(link)["turns"])
            (stored,) = database.execute("SELECT count(*) FROM packets").fetchone()
            (applied,) = database.execute("SELECT ifnull(max(value), 0) FROM facts WHERE name = 'applied'").fetchone()
            looks.append(Look(time.perf_counter(), stored, int(applied), drawn))
            await asyncio.sleep(LOOK_EVERY_S)


def _corrected(chosen: Sequence[Sent], answers: Sequence[Sent], looks: Sequence[Look]) -> list[float]:
    """For each request the time until the robot had the first answer that it asked for after the effect."""
    by_robot: dict[str, list[Sent]] = {}
    for each in answers:
        by_robot.setdefault(each.robot, []).append(each)
    latencies = []
    for each, effect_s in zip(chosen, _effect(chosen, looks), strict=True):
        in_effect = each.answered_s + effect_s
        following = next(answer for answer in by_robot[each.robot] if answer.asked_s >= in_effect)
        latencies.append(following.answered_s - each.asked_s)
    return latencies


def _effect(
    chosen: Sequence[Sent], looks: Sequence[Look], count: Callable[[Look], int] = lambda look: look.applied
) -> list[float]:
    """For each request the time until as many packets had taken effect as were stored when it was answered.

    ``count``: how many had by a look; by default they are in the fleet.
    """
    at = np.array([look.at_s for look in looks])
    stored = np.maximum.accumulate([look.stored for look in looks])
    applied = np.maximum.accumulate([count(look) for look in looks])
    latencies = []
    for each in chosen:
        seen = min(int(np.searchsorted(at, each.answered_s)), len(at) - 1)
        done = min(int(np.searchsorted(applied, stored[seen])), len(at) - 1)
        latencies.append(float(at[done] - each.answered_s))
    return latencies


def _spread(seconds: Sequence[float]) -> tuple[float, ...]:
    """Median, 95 %, 99 % and most, in milliseconds."""
    return tuple(1e3 * float(value) for value in np.quantile(seconds, (0.5, 0.95, 0.99, 1.0)))


def _children(pid: int) -> list[int]:
    files = Path(f"/proc/{pid}/task").glob("*/children")
    return [int(child) for file in files for child in file.read_text(encoding="ascii").split()]


def _cpu_s(pid: int) -> float:
    fields = Path(f"/proc/{pid}/stat").read_text(encoding="ascii").rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def _peak_mb(pid: int) -> float:
    lines = Path(f"/proc/{pid}/status").read_text(encoding="ascii").splitlines()
    return next(float(line.split()[1]) / 1e3 for line in lines if line.startswith("VmHWM"))


if __name__ == "__main__":
    main()
