"""Three instances over one PostgreSQL server whose machines fail: real processes on loopback.

    python benchmarks/instances.py [--kills 30] [--restarts 5] [--cuts 1] [--only latency|faults|room]

Ten missions of five robots each send to three instances of `fcslam serve --store`. Five simulated buildings are used
twice. Each robot sends its packets in small batches to an instance chosen at random, and to the next one when it gets
no answer. Its recording is spread over all faults. Faults come one after another in random order:

- kill: SIGKILL to an instance; it starts again after its missions have ready workers on the others.
- restart: PostgreSQL is stopped without a checkpoint (`pg_ctl -m immediate`) and started again.
- cut: nothing passes between one instance and the server for 30 s, and no connection is closed meanwhile.

"Fail-over" is the time from a kill or a cut until a mission of that instance has a ready worker elsewhere, for each
mission. After all faults the result of each mission is compared with what `fcslam map` makes of the same recordings.
A packet is acknowledged when a request with it got status 200. "Lost" counts those that the exported mission lacks.

"Latency": the same batches go to a service with SQLite files and to an instance with PostgreSQL, in turn, from twenty
robots of one mission; blocks of ten seconds alternate. "Intake": one thread, without HTTP and workers.

"Room": three instances have room for one mission each, and five missions want a worker. The instance with the open
mission is killed again and again.
"""

import json
import os
import random
import secrets
import signal
import socket
import sys
import tempfile
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Iterable, Mapping, Sequence
from contextlib import closing, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import common
import httpx
import numpy as np
from processes import PATIENCE_S, Process, compare, wait_for

from fcslam.cli import main as fcslam
from fcslam.cloud.settings import CloudConfig
from fcslam.lab.simulation.noise import LidarSettings
from fcslam.lab.simulation.simulated_fleet import SimulationSettings, simulate_fleet
from fcslam.mission.mission_store import MissionStore
from fcslam.robot.frontend import RobotConfig, RobotFrontend
from fcslam.service.intake import Intake
from fcslam.service.shared.mission_tables import MissionTables, prepare
from fcslam.service.shared.registry import Registry
from fcslam.sources import open_source, write_bag
from fcslam.storage.postgres import Postgres, take_password
from fcslam.wire.batches import MEDIA_TYPE, write_batch
from fcslam.wire.packets import decode, encode

sys.path.insert(0, str(common.REPOSITORY))
from tests.postgres import HAS_POSTGRES, Server, free_port

BUILDINGS, MISSIONS, ROBOTS, WANTED = 5, 10, 5, 5
PATH_M, SEED = 20.0, 4200
NAMES = ("one", "two", "three")
CUT_S = 30.0
FAULTS = {"fault": "", "count": "d", "fail-overs": "d", "median, s": ".1f", "95 %, s": ".1f", "longest, s": ".1f"}
MISSION = {"mission": "", "packets acknowledged": "d", "lost": "d", "twice": "d", "as `fcslam map`, byte for byte": ""}
INTAKE = {"store": "", "batches": "d", "median, ms": ".2f", "99 %, ms": ".2f", "CPU of this process, ms": ".2f"}
LATENCY = {"store": "", "requests": "d", "median, ms": ".1f", "95 %, ms": ".1f", "99 %, ms": ".1f"}
STEP_S = 15.0
"""The share of packets that belongs to a fault is sent in this time."""
LATENCY_ROBOTS, BLOCKS, BLOCK_S, PAUSE_S = 20, 6, 10.0, 0.5


@dataclass(frozen=True)
class Building:
    """Recordings of one building's robots, what they send, and the run of `fcslam map`."""

    packets: dict[str, list[bytes]]
    reference: Path


def building(number: int, place: Path) -> Building:
    """Simulate, drive and map a building."""
    lidar = LidarSettings(beams=180, rate_hz=3.0)
    settings = SimulationSettings(robots=ROBOTS, path_length_m=PATH_M, lidar=lidar, camera=None)
    place.mkdir(parents=True, exist_ok=True)
    logs, packets = [], {}
    for robot in simulate_fleet(settings, SEED + number).robots:
        name = f"b{number}-{robot.name}"
        logs.append(place / f"{name}.mcap")
        write_bag(logs[-1], robot.scans())
        source, frontend = open_source(logs[-1]), RobotFrontend(name, RobotConfig())
        sent = [packet for record in source.records() for packet in frontend.process(record)]
        packets[name] = [encode(packet) for packet in sent + frontend.finish()]
    reference = place / "run"
    if not reference.exists() and fcslam(["map", *map(str, logs), "-o", str(reference), "--quiet"]):
        sys.exit("fcslam map failed")
    return Building(packets, reference)


class Proxy:
    """Passes bytes to the server until it is cut; then it keeps connections and passes nothing."""

    def __init__(self, port: int) -> None:
        self._to, self._is_cut = port, threading.Event()
        self._listening = socket.create_server(("127.0.0.1", 0))
        self.port = self._listening.getsockname()[1]
        threading.Thread(target=self._accept, daemon=True).start()

    def cut(self, seconds: float) -> None:
        """Let nothing through for a while; connections of before are useless afterwards, and are closed."""
        self._is_cut.set()
        time.sleep(seconds)
        self._is_cut.clear()

    def _accept(self) -> None:
        while True:
            near, _ = self._listening.accept()
            threading.Thread(target=self._pass, args=(near,), daemon=True).start()

    def _pass(self, near: socket.socket) -> None:
        with suppress(OSError), near:
            while self._is_cut.is_set():
                time.sleep(0.05)
            with socket.create_connection(("127.0.0.1", self._to)) as far:
                back = threading.Thread(target=self._copy, args=(far, near), daemon=True)
                back.start()
                self._copy(near, far)
                back.join()

    def _copy(self, source: socket.socket, target: socket.socket) -> None:
        with suppress(OSError):
            while data := source.recv(2**16):
                while self._is_cut.is_set():
                    time.sleep(0.05)
                target.sendall(data)
        for end in (source, target):
            with suppress(OSError):
                end.shutdown(socket.SHUT_RDWR)


@dataclass
class Progress:
    """How much of the recordings may be sent by now."""

    total: int
    done: int = 0
    began: float = field(default_factory=time.monotonic)

    def next(self) -> None:
        """The next fault begins."""
        self.done, self.began = self.done + 1, time.monotonic()

    @property
    def share(self) -> float:
        """From 0 to 1."""
        return min(1.0, (self.done + min(1.0, (time.monotonic() - self.began) / STEP_S)) / self.total)


class Sender(threading.Thread):
    """A robot that sends to any instance that answers."""

    def __init__(self, mission: str, robot: str, packets: Sequence[bytes], ports: Sequence[int], progress: Progress,
                 seed: int) -> None:  # fmt: skip
        super().__init__(daemon=True)
        self.mission, self.robot, self.packets = mission, robot, packets
        self.acknowledged = 0
        self.refused: list[str] = []
        self._ports, self._progress, self._random = list(ports), progress, random.Random(seed)
        self._agent = secrets.token_hex(8)

    def run(self) -> None:
        """Send all packets; those that were not acknowledged again."""
        while self.acknowledged < len(self.packets):
            allowed = int(len(self.packets) * self._progress.share)
            batch = self.packets[self.acknowledged : min(allowed, self.acknowledged + 8)]
            if batch and self._send(batch):
                self.acknowledged += len(batch)
            else:
                time.sleep(0.5)

    def _send(self, batch: Sequence[bytes]) -> bool:
        for port in self._random.sample(self._ports, len(self._ports)):
            address = f"http://127.0.0.1:{port}/missions/{self.mission}/api/v1/robots/{self.robot}/packets"
            headers = {"Content-Type": MEDIA_TYPE, "Fcslam-Agent": self._agent}
            asked = urllib.request.Request(address, write_batch(batch), headers)
            try:
                with urllib.request.urlopen(asked, timeout=20.0) as answer:
                    return bool(answer.status == 200)
            except urllib.error.HTTPError as error:
                if error.code not in (429, 500, 503, 507):
                    self.refused.append(error.read().decode())
            except OSError:
                pass
        return False


class Fleet:
    """Three instances, one of them behind a proxy, over a server."""

    def __init__(self, place: Path, server: Server) -> None:
        self.server, self._place = server, place
        self.proxy = Proxy(server.port)
        self.ports = {name: free_port() for name in NAMES}
        self.processes = {name: self._start(name) for name in NAMES}
        for name in NAMES:
            wait_for(self.ports[name], self.processes[name])

    def _start(self, name: str) -> Process:
        port = self.proxy.port if name == NAMES[-1] else self.server.port
        url = f"postgresql://fcslam@127.0.0.1:{port}/postgres"
        options = ("--store", url, "--data", self._place / name, "--port", self.ports[name])
        return Process(("serve", *options), self._place / f"{name}.log")

    def stop(self) -> None:
        """End all instances in order."""
        for process in self.processes.values():
            process.process.send_signal(signal.SIGTERM)
        for process in self.processes.values():
            process.process.wait(PATIENCE_S)


class Watch:
    """Which instance has the ready worker of each mission."""

    def __init__(self, url: str, ports: Mapping[str, int]) -> None:
        self._names = {str(port): name for name, port in ports.items()}
        self._server = Postgres(url, "benchmark")

    def held(self) -> dict[str, str]:
        """Instance of each mission that has a ready worker."""
        while True:
            with suppress(Exception):
                rows = self._server.rows(
                    "SELECT name, holder FROM missions WHERE is_ready AND expires > clock_timestamp()"
                )
                return {mission: self._names[holder.rpartition("-")[2]] for mission, holder in rows}

    def fail_over(self, name: str, missions: Iterable[str], since: float) -> list[float]:
        """Seconds until each of the missions has a ready worker on another instance."""
        waiting, times = set(missions), []
        while waiting:
            held = self.held()
            now = time.monotonic()
            for mission in [mission for mission in waiting if held.get(mission, name) != name]:
                waiting.discard(mission)
                times.append(now - since)
            if now > since + PATIENCE_S:
                sys.exit(f"missions {waiting} have no worker")
            time.sleep(0.05)
        return times

    def settle(self, missions: int) -> None:
        """Wait until the missions are spread."""
        until = time.monotonic() + PATIENCE_S
        while time.monotonic() < until:
            held = self.held()
            counts = [list(held.values()).count(name) for name in NAMES]
            if len(held) >= missions and min(counts) >= missions // len(NAMES):
                return
            time.sleep(0.2)
        sys.exit("the missions are not spread")


def post(port: int, path: str, body: bytes = b"") -> Any:
    """The answer to a POST; it is asked again while the service is not ready."""
    until = time.monotonic() + PATIENCE_S
    while True:
        try:
            with urllib.request.urlopen(f"http://127.0.0.1:{port}{path}", data=body, timeout=PATIENCE_S) as answer:
                return json.load(answer)
        except urllib.error.HTTPError as error:
            if error.code not in (503, 507) or time.monotonic() > until:
                sys.exit(f"{path}: {error.code} {error.read().decode()}")
            time.sleep(0.5)


def faults(chosen: Any, place: Path, buildings: Sequence[Building], report: common.Report) -> None:
    """Send, break and compare."""
    server = Server(place / "server")
    url = take_password(server.url)
    fleet = Fleet(place, server)
    watch = Watch(url, fleet.ports)
    missions = {f"m{number}": buildings[number % BUILDINGS] for number in range(MISSIONS)}
    for name in missions:
        post(fleet.ports["one"], "/api/v1/missions", json.dumps({"name": name}).encode())
    chance = random.Random(SEED)
    kinds = ["kill"] * chosen.kills + ["restart"] * chosen.restarts + ["cut"] * chosen.cuts
    chance.shuffle(kinds)
    watch.settle(MISSIONS + 1)
    progress = Progress(len(kinds) + 1)
    senders = [
        Sender(name, robot, packets, list(fleet.ports.values()), progress, number)
        for number, (name, building) in enumerate(missions.items())
        for robot, packets in building.packets.items()
    ]
    for sender in senders:
        sender.start()
    times: dict[str, list[float]] = {"kill": [], "cut": []}
    for number, kind in enumerate(kinds):
        time.sleep(chance.uniform(0.0, 5.0))
        print(f"{number + 1} of {len(kinds)}: {kind}", file=sys.stderr)
        if kind == "restart":
            server.stop()
            time.sleep(chance.uniform(0.0, 2.0))
            server.start()
        else:
            victim = NAMES[-1] if kind == "cut" else chance.choice(NAMES)
            of_victim = [mission for mission, holder in watch.held().items() if holder == victim]
            began = time.monotonic()
            if kind == "kill":
                fleet.processes[victim].kill()
                times[kind] += watch.fail_over(victim, of_victim, began)
                fleet.processes[victim].start()
            else:
                cutting = threading.Thread(target=fleet.proxy.cut, args=(CUT_S,))
                cutting.start()
                times[kind] += watch.fail_over(victim, of_victim, began)
                cutting.join()
        progress.next()
        watch.settle(MISSIONS + 1)
    for sender in senders:
        sender.join(PATIENCE_S)
        if sender.is_alive() or sender.refused:
            sys.exit(f"{sender.mission} {sender.robot}: {sender.refused or 'did not finish'}")
    report.table(
        "Faults", FAULTS, [fault_row(kind, kinds.count(kind), times.get(kind, [])) for kind in sorted(set(kinds))]
    )
    rows = []
    for number, (name, building) in enumerate(missions.items()):
        sent = [data for sender in senders if sender.mission == name for data in sender.packets]
        rows.append((name, *outcome(fleet.ports[NAMES[number % len(NAMES)]], name, sent, building, place)))
    report.table("Missions", MISSION, rows)
    fleet.stop()
    server.stop()


def room(chosen: Any, place: Path, report: common.Report) -> None:
    """Kill the instance that has the open mission where there are more missions than workers."""
    os.environ["FCSLAM_MAX_MISSIONS"] = "1"
    server = Server(place / "server")
    url = take_password(server.url)
    fleet = Fleet(place, server)
    watch = Watch(url, fleet.ports)
    for number in range(WANTED):
        post(fleet.ports["one"], "/api/v1/missions", json.dumps({"name": f"m{number}"}).encode())
    wanted = Postgres(url, "room")
    times: list[float] = []
    for _ in range(chosen.kills):
        wanted.rows("UPDATE missions SET is_wanted = true RETURNING name")
        mission = next(name for is_open, name in wanted.rows("SELECT is_open, name FROM missions") if is_open)
        until = time.monotonic() + PATIENCE_S
        while mission not in (held := watch.held()) or len(held) < len(NAMES):
            if time.monotonic() > until:
                sys.exit(f"{mission} has no worker, or an instance has no mission: {held}")
            time.sleep(0.1)
        time.sleep(STEP_S)  # each instance prepares a worker for the next mission
        victim, began = held[mission], time.monotonic()
        fleet.processes[victim].kill()
        times += watch.fail_over(victim, [mission], began)
        print(f"{times[-1]:.1f} s", file=sys.stderr, flush=True)
        fleet.processes[victim].start()
    report.table("The open mission, with room for three of five", FAULTS, [fault_row("kill", chosen.kills, times)])
    fleet.stop()
    server.stop()


def fault_row(kind: str, count: int, times: Sequence[float]) -> tuple[Any, ...]:
    """A row of ``FAULTS``."""
    return kind, count, len(times), *(quantiles(times, (0.5, 0.95, 1.0)) if times else (None, None, None))


def outcome(port: int, mission: str, sent: Sequence[bytes], building: Building, place: Path) -> tuple[Any, ...]:
    """A row of ``MISSION`` without the name."""
    run = Path(post(port, f"/missions/{mission}/api/v1/finalize")["run"])
    exported = place / f"{mission}.sqlite"
    with urllib.request.urlopen(f"http://127.0.0.1:{port}/api/v1/missions/{mission}/export") as answer:
        exported.write_bytes(answer.read())
    with closing(MissionStore(exported)) as store:
        stored = [packet.data for _, packet in store.arrivals(0, 10**6)]
    lost = sum(data not in set(stored) for data in sent)
    return len(sent), lost, len(stored) - len(set(stored)), "yes" if compare(run, building.reference).passed else "NO"


def quantiles(values: Sequence[float], shares: Sequence[float]) -> list[float]:
    """Quantiles that are values."""
    return [float(np.quantile(values, share, method="higher")) for share in shares]


def latency(place: Path, buildings: Sequence[Building], report: common.Report) -> None:
    """The same batches to both stores."""
    server = Server(place / "server-of-latency")
    url = take_password(server.url)
    every = [packets for building in buildings for packets in building.packets.values()]
    report.table("Intake", INTAKE, intake_rows(place, url, every))
    ports = {"SQLite": free_port(), "PostgreSQL": free_port()}
    stored = {"SQLite": (), "PostgreSQL": ("--store", url)}
    servers = {
        store: Process(
            ("serve", "--data", place / f"of-{store}", "--port", port, *stored[store]), place / f"{store}.log"
        )
        for store, port in ports.items()
    }
    for store, port in ports.items():
        wait_for(port, servers[store])
    times: dict[str, list[float]] = {store: [] for store in ports}
    sent = dict.fromkeys(ports, 0)
    for block in range(2 * BLOCKS):
        store = list(ports)[block % 2]
        threads = [
            threading.Thread(target=play, args=(ports[store], packets, sent[store], times[store]))
            for packets in every[:LATENCY_ROBOTS]
        ]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        sent[store] += round(BLOCK_S / PAUSE_S)
    for process in servers.values():
        process.process.send_signal(signal.SIGTERM)
        process.process.wait(PATIENCE_S)
    server.stop()
    shares = (0.5, 0.95, 0.99)
    rows = [(store, len(taken), *(1e3 * one for one in quantiles(taken, shares))) for store, taken in times.items()]
    report.table("Latency", LATENCY, rows)


def play(port: int, packets: Sequence[bytes], first: int, times: list[float]) -> None:
    """Send a packet in each pause for the time of a block."""
    robot = decode(packets[0]).robot
    headers = {"Content-Type": MEDIA_TYPE, "Fcslam-Agent": "latency"}
    path = f"/api/v1/robots/{robot}/packets"
    time.sleep(random.random() * PAUSE_S)
    with httpx.Client(base_url=f"http://127.0.0.1:{port}", headers=headers, timeout=30.0) as client:
        for number in range(first, first + round(BLOCK_S / PAUSE_S)):
            began = time.perf_counter()
            answer = client.post(path, content=write_batch(packets[number : number + 1]))
            times.append(time.perf_counter() - began)
            if answer.status_code != 200:
                sys.exit(answer.text)
            time.sleep(max(0.0, PAUSE_S - (time.perf_counter() - began)))


def intake_rows(place: Path, url: str, every: Sequence[Sequence[bytes]]) -> list[tuple[Any, ...]]:
    """Batches of four packets to both stores in turn."""
    with closing(Postgres(url, "benchmark")) as server:
        prepare(server)
        number = Registry(server, "benchmark", "benchmark").create("latency")
        stores = {
            "SQLite": MissionStore(place / "latency.sqlite"),
            "PostgreSQL": MissionStore(MissionTables(server, number)),
        }
        intakes = {}
        for name, store in stores.items():
            store.configure(CloudConfig())
            intakes[name] = Intake(store, time.monotonic, time.time)
        taken: dict[str, list[float]] = {name: [] for name in stores}
        spent = dict.fromkeys(stores, 0.0)
        for packets in every:
            robot = decode(packets[0]).robot
            for begin in range(0, len(packets), 4):
                batch = write_batch(packets[begin : begin + 4])
                for name, intake in intakes.items():
                    began, cpu = time.perf_counter(), time.process_time()
                    intake.take(robot, "x", batch, -1)
                    taken[name].append(time.perf_counter() - began)
                    spent[name] += time.process_time() - cpu
        for store in stores.values():
            store.close()
        server.rows("DELETE FROM missions RETURNING 1")  # no instance shall map it
    return [
        (name, len(one), *(1e3 * value for value in quantiles(one, (0.5, 0.99))), 1e3 * spent[name] / len(one))
        for name, one in taken.items()
    ]


def main() -> None:
    """Measure and write the report."""
    parser = common.options(__doc__)
    parser.add_argument("--kills", type=int, default=30)
    parser.add_argument("--restarts", type=int, default=5)
    parser.add_argument("--cuts", type=int, default=1)
    parser.add_argument("--only", choices=("latency", "faults", "room"), help="one part")
    parser.add_argument("--recordings", type=Path, help="folder that keeps the recordings and their maps")
    chosen = parser.parse_args()
    if not HAS_POSTGRES:
        print("skipped: needs PostgreSQL and psycopg: make scale-test")
        return
    report = common.Report(__file__, __doc__, chosen)
    with tempfile.TemporaryDirectory(prefix="fcslam-instances-") as folder:
        place = Path(folder)
        place.chmod(0o755)  # the server's user must reach its folder
        recordings = chosen.recordings or place
        if chosen.only in (None, "room"):
            crowded = place / "room"
            crowded.mkdir(mode=0o755)
            room(chosen, crowded, report)
            os.environ.pop("FCSLAM_MAX_MISSIONS")
        if chosen.only == "room":
            report.write()
            return
        buildings = [building(number, recordings / f"building{number}") for number in range(BUILDINGS)]
        if chosen.only != "faults":
            latency(place, buildings, report)
        if chosen.only != "latency":
            faults(chosen, place, buildings, report)
    report.write()


if __name__ == "__main__":
    main()
