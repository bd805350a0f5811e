"""The same map whatever the network, the machines and their disks do: real processes on loopback.

    python benchmarks/faults.py

A simulated fleet is mapped by `fcslam serve` and one `fcslam robot` a robot, which play their recordings faster than
they were made and reach the server through a proxy that does to requests what the scenario says: loses them or their
answers, cuts them in the middle, delays them, lets them arrive twice and in another order, or lets nothing through
for what is five minutes of the recording. Processes are killed (SIGKILL) at random instants and started again; the
server's disk is full for a while; the robots' clocks are minutes apart.

The scenario "killed, a real log" needs recordings and runs only when `--scenarios` names it. It maps one log of
the SLAM benchmark, cut into robots, over a network that cuts, doubles and delays requests. In each round it kills
server, worker and robots up to twelve times; it kills no robot that is done. Each round has the next seed. For about
100 kills:

    FCSLAM_DATA=/path/to/data python benchmarks/faults.py --scenarios "killed, a real log" --rounds 12 --keep FILE

After each scenario the result is asked for and compared with what `fcslam map` makes of the same recordings in one
process: closures (all lines of closures.csv), pose graph (largest difference of any number), bytes of the map, poses at
keyscans, packets that count.
"""

import asyncio
import itertools
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import ExitStack, closing, suppress
from dataclasses import astuple, dataclass, replace
from pathlib import Path
from typing import Any

import common
import numpy as np
from processes import PATIENCE_S, Process, cloud, compare, finalize, robot, wait_for, yes

ROBOTS, PATH_M, SPEED = 3, 60.0, 8.0
MANY_ROBOTS, MANY_PATH_M, MANY_SPEED = 20, 12.0, 2.0
OUTAGE_S = 300.0
"""Of the recording's time."""
SKEW_S = 240.0
LATE_S = 3.0
"""Up to so much later a request arrives for the second time."""


@dataclass(frozen=True)
class Scenario:
    """What goes wrong, as shares of all requests and numbers of events."""

    lost: float = 0.0
    """The request never arrives; as many answers are lost on their way back."""
    cut: float = 0.0
    """The connection breaks in the middle of the request."""
    twice: float = 0.0
    """The request arrives once more, up to LATE_S later: after its successors."""
    delay_s: float = 0.0
    """Up to so long it is on its way."""
    away: bool = False
    """For OUTAGE_S of the recording nothing gets through."""
    server_kills: int = 0
    worker_kills: int = 0
    """The server lives on; only the process in which its fleet lives is killed."""
    robot_kills: int = 0
    disk_full: bool = False
    """The server cannot write for a third of the recording."""
    skewed: bool = False
    """Each robot's clock is SKEW_S ahead of the one before."""
    robots: int = ROBOTS
    path_m: float = PATH_M
    speed: float = SPEED
    """So many times as fast as recorded."""
    log: str = ""
    """A log of the SLAM benchmark, cut into so many robots; none: a simulated fleet."""


REAL = "killed, a real log"
SCENARIOS = {
    "undisturbed": Scenario(),
    "30 % lost": Scenario(lost=0.15, cut=0.05),
    "5 minutes away": Scenario(away=True),
    "late and out of order": Scenario(twice=0.5, delay_s=1.0),
    "everything twice": Scenario(twice=1.0),
    "server killed": Scenario(server_kills=4),
    "worker killed": Scenario(worker_kills=4),
    "robots killed": Scenario(robot_kills=6),
    "all at once": Scenario(lost=0.1, cut=0.05, twice=0.3, delay_s=0.5, server_kills=2, robot_kills=3),
    "disk full": Scenario(disk_full=True),
    "clocks apart": Scenario(skewed=True),
    "20 robots, server killed": Scenario(robots=MANY_ROBOTS, path_m=MANY_PATH_M, speed=MANY_SPEED, server_kills=4),
    REAL: Scenario(
        lost=0.1, cut=0.05, twice=0.3, delay_s=0.5, server_kills=4, worker_kills=4, robot_kills=4, log="intel"
    ),
}

COLUMNS = {"scenario": "", "seed": "", "robots": "", "packets": ",.0f", "lost": ".0f", "twice": ".0f", "closures": "",
           "the same": "", "graph off by": ".1e", "map the same": "", "poses the same": "", "requests": ",.0f",
           "disturbed": ",.0f", "turned away": ",.0f", "kills": "", "s": ".0f", "passed": ""}  # fmt: skip


def main() -> None:
    parser = common.options(__doc__)
    parser.add_argument(
        "--scenarios", nargs="+", choices=SCENARIOS, default=[name for name in SCENARIOS if name != REAL]
    )
    parser.add_argument("--robots", type=int, help=f"in each scenario ({ROBOTS}, and {MANY_ROBOTS} in the last one)")
    parser.add_argument("--path", type=float, help=f"of each robot, m ({PATH_M}, {MANY_PATH_M})")
    parser.add_argument("--speed", type=float, help=f"so many times as fast as recorded ({SPEED}, {MANY_SPEED})")
    parser.add_argument("--seed", type=int, default=1, help="of the fleet and of the first round's faults")
    parser.add_argument("--rounds", type=int, default=1, help="of each scenario, each with the next seed")
    parser.add_argument("--keep", type=Path, help="file that keeps finished rounds; the same one resumes")
    chosen = parser.parse_args()
    kept = common.Kept(chosen.keep)
    report = common.Report(__file__, __doc__, chosen)
    rows = []
    with tempfile.TemporaryDirectory() as place:
        worlds = Worlds(Path(place), chosen.seed)
        for name, seed in itertools.product(chosen.scenarios, range(chosen.seed, chosen.seed + chosen.rounds)):
            scenario = SCENARIOS[name]
            changes = {"robots": chosen.robots, "path_m": chosen.path, "speed": chosen.speed}
            scenario = replace(scenario, **{key: value for key, value in changes.items() if value is not None})
            folder = Path(place) / f"{name.replace(' ', '-')}-{seed}"
            rows += kept.rows(
                (*astuple(scenario), chosen.seed, seed),
                lambda name=name, scenario=scenario, folder=folder, seed=seed: [
                    (name, seed, *play(scenario, worlds, folder, seed))
                ],
            )
            print(*rows[-1], flush=True)
    report.table("Scenarios", COLUMNS, rows)
    report.write()
    if not all(row[-1] == "yes" for row in rows):
        sys.exit("faults: a scenario failed")


class Worlds:
    """Recordings, and what `fcslam map` makes of them; each is made once."""

    def __init__(self, folder: Path, seed: int) -> None:
        self._folder = folder
        self._seed = seed
        self._known: dict[tuple[str, int, float, bool], tuple[list[Path], Path, float]] = {}

    def get(self, scenario: Scenario) -> tuple[list[Path], Path, float]:
        """Recordings, the run folder of reference, and the longest recording's duration in seconds."""
        key = scenario.log, scenario.robots, scenario.path_m, scenario.skewed
        if key not in self._known:
            folder = self._folder / f"world-{len(self._known)}"
            folder.mkdir()
            logs, duration_s = self._record(scenario, folder)
            common.run_fcslam("map", *logs, "--output", folder / "run")
            self._known[key] = logs, folder / "run", duration_s
        return self._known[key]

    def _record(self, scenario: Scenario, folder: Path) -> tuple[list[Path], float]:
        from fcslam.lab.simulation.noise import LidarSettings
        from fcslam.lab.simulation.simulated_fleet import SimulationSettings, simulate_fleet
        from fcslam.sources import write_bag

        if scenario.log:
            return self._cut(scenario, folder)
        lidar = LidarSettings(beams=180, rate_hz=3.0)
        settings = SimulationSettings(robots=scenario.robots, path_length_m=scenario.path_m, lidar=lidar, camera=None)
        logs, longest_s = [], 0.0
        for number, driven in enumerate(simulate_fleet(settings, self._seed).robots):
            logs.append(folder / f"{driven.name}.mcap")
            skew_s = number * SKEW_S * scenario.skewed
            write_bag(logs[-1], (replace(scan, stamp=scan.stamp + skew_s) for scan in driven.scans()))
            longest_s = max(longest_s, float(driven.stamps[-1] - driven.stamps[0]))
        return logs, longest_s

    def _cut(self, scenario: Scenario, folder: Path) -> tuple[list[Path], float]:
        from fcslam.sources import open_source, split, write_bag

        path = common.log_path(common.recordings(f"slam-benchmark/{scenario.log}.clf.xz"), scenario.log)
        logs, longest_s = [], 0.0
        for part in split(open_source(path), scenario.robots):
            logs.append(folder / f"{part.name.replace('.', '-')}.mcap")
            records = list(part.records())
            write_bag(logs[-1], records)
            longest_s = max(longest_s, records[-1].stamp - records[0].stamp)
        return logs, longest_s


class Proxy:
    """Passes HTTP requests on, or does what the scenario says; runs in a thread of its own."""

    def __init__(self, scenario: Scenario, to_port: int, rng: np.random.Generator) -> None:
        self.counts: Counter[str] = Counter()
        self.is_open = True
        self._scenario = scenario
        self._to_port = to_port
        self._rng = rng
        self._loop = asyncio.new_event_loop()
        self._late: set[asyncio.Task[Any]] = set()
        self._thread = threading.Thread(target=self._loop.run_forever, daemon=True)
        self._thread.start()
        starting = asyncio.start_server(self._serve, "127.0.0.1", 0)
        self._server = asyncio.run_coroutine_threadsafe(starting, self._loop).result()
        self.port: int = self._server.sockets[0].getsockname()[1]

    def open(self, is_open: bool) -> None:
        """Whether anything gets through."""
        self.is_open = is_open

    def close(self) -> None:
        asyncio.run_coroutine_threadsafe(self._end(), self._loop).result()
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()
        self._loop.close()

    async def _end(self) -> None:
        self._server.close()
        tasks = asyncio.all_tasks() - {asyncio.current_task()}
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        with suppress(OSError, asyncio.IncompleteReadError):
            while answer := await self._pass_on(await http_message(reader)):
                writer.write(answer)
                await writer.drain()
        writer.transport.abort()

    async def _pass_on(self, request: bytes) -> bytes | None:
        """The answer; None: the connection breaks."""
        self._weigh("up", request)
        scenario, (lost, answer_lost, cut, twice, late) = self._scenario, self._rng.random(5)
        self.counts["requests"] += 1
        disturbed = not self.is_open or lost < scenario.lost or answer_lost < scenario.lost or cut < scenario.cut
        self.counts["disturbed"] += bool(disturbed or twice < scenario.twice)
        if not self.is_open or lost < scenario.lost:
            return None
        await asyncio.sleep(float(self._rng.uniform(0.0, scenario.delay_s)))
        if cut < scenario.cut:
            await self._ask(request[: len(request) // 2], wait=False)
            return None
        if twice < scenario.twice:
            task = asyncio.ensure_future(self._once_more(request, late * LATE_S))
            self._late.add(task)
            task.add_done_callback(self._late.discard)
        answer = await self._ask(request)
        self.counts["turned away"] += answer is not None and not answer.startswith(b"HTTP/1.1 200")
        self._weigh("down", answer or b"")
        return None if answer_lost < scenario.lost else answer

    def _weigh(self, direction: str, message: bytes) -> None:
        """Count its bytes: HTTP's own, and what it carries."""
        carried = len(message.partition(b"\r\n\r\n")[2])
        self.counts[f"{direction}, HTTP"] += len(message) - carried
        self.counts[f"{direction}, carried"] += carried

    async def _once_more(self, request: bytes, after_s: float) -> None:
        await asyncio.sleep(after_s)
        await self._ask(request)

    async def _ask(self, request: bytes, wait: bool = True) -> bytes | None:
        try:
            reader, writer = await asyncio.open_connection("127.0.0.1", self._to_port)
            writer.write(request)
            await writer.drain()
            answer = await http_message(reader) if wait else None
        except (OSError, asyncio.IncompleteReadError):
            return None
        writer.transport.abort()
        return answer


async def http_message(reader: asyncio.StreamReader) -> bytes:
    """A request or an answer, head and body."""
    head = await reader.readuntil(b"\r\n\r\n")
    lengths = [line.split(b":")[1] for line in head.lower().split(b"\r\n") if line.startswith(b"content-length:")]
    return head + await reader.readexactly(int(lengths[0]) if lengths else 0)


def play(scenario: Scenario, worlds: Worlds, place: Path, seed: int) -> tuple:
    """One scenario from empty folders to the compared result; a row without its name and seed."""
    place.mkdir()
    rng = np.random.default_rng(seed)
    logs, reference, duration_s = worlds.get(scenario)
    began = time.perf_counter()
    with cloud(place) as (server, port), closing(Proxy(scenario, port, rng)) as proxy, ExitStack() as stack:
        robots = [stack.enter_context(robot(log, proxy.port, place, scenario.speed)) for log in logs]
        disturb(scenario, server, robots, proxy, duration_s / scenario.speed, rng)
        wait_for(port, server)  # the last kill may have been a moment ago
        run = finalize(port)
    kills = server.kills + sum(process.kills for process in robots)
    compared = compare(run, reference)
    elapsed_s = time.perf_counter() - began
    return (
        len(logs),
        *compared,
        proxy.counts["requests"],
        proxy.counts["disturbed"],
        proxy.counts["turned away"],
        kills,
        elapsed_s,
        yes(compared.passed),
    )


def disturb(
    scenario: Scenario, server: Process, robots: Sequence[Process], proxy: Proxy, play_s: float,
    rng: np.random.Generator,
) -> None:  # fmt: skip
    """Let the scenario's events happen while the robots play, and wait until the server has all that they said."""
    events: list[tuple[float, Callable[[], None]]] = []
    if scenario.away:
        back_s = play_s / 3.0 + OUTAGE_S / scenario.speed
        events += [(play_s / 3.0, lambda: proxy.open(False)), (back_s, lambda: proxy.open(True))]
    if scenario.disk_full:
        events += [(play_s / 3.0, server.fill_disk), (play_s * 2.0 / 3.0, server.empty_disk)]
    events += [(at, server.kill_and_start) for at in rng.uniform(0.1, 1.1, scenario.server_kills) * play_s]
    events += [(at, server.kill_children) for at in rng.uniform(0.1, 1.1, scenario.worker_kills) * play_s]
    victims = rng.choice(len(robots), scenario.robot_kills)
    instants = rng.uniform(0.1, 1.0, scenario.robot_kills) * play_s
    events += [(at, robots[victim].kill_and_start) for at, victim in zip(instants, victims, strict=True)]
    events.sort(key=lambda event: event[0])
    began = time.monotonic()
    while proxy.counts["requests"] < len(robots) and time.monotonic() - began < PATIENCE_S:
        time.sleep(0.05)  # starting takes long on a busy machine
    began = time.monotonic()
    while events or not all(process.ended() for process in robots):
        if events and time.monotonic() - began >= events[0][0]:
            events.pop(0)[1]()
        if time.monotonic() - began > PATIENCE_S:
            sys.exit(f"robots are not done after {PATIENCE_S} s; see {robots[0].log.parent}")
        server.ended()
        time.sleep(0.05)


if __name__ == "__main__":
    main()
