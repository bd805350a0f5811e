"""Verification of closures on a pool of processes: 10,000 pairs, one process against two.

    python benchmarks/verification.py [--pairs 10000] [--dask 2]

The pairs are those that a mission of simulated robots in one building compares, again and again until they are enough.
A call has as many as there are places to compare while the fleet is small (`fleet.matcher.small_fleet`), or all. One
process is this one; of two, this one and another share the pairs. Dask's local workers are processes of this machine
beside it. All of them are started and have loaded their code before the clock runs. Wall-clock time: the machine must
be quiet. The last column needs no quiet machine: CPU of one process, against that of the busiest.
"""

import itertools
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor, ProcessPoolExecutor
from contextlib import ExitStack, contextmanager
from importlib.util import find_spec
from multiprocessing import get_context
from pathlib import Path

import common

AT_ONCE = 150
COLUMNS = {
    "processes": "s",
    "at once": ",",
    "pairs": ",",
    "time, s": ".1f",
    "a pair, ms": ".2f",
    "against one": ".2f",
    "by CPU": ".2f",
}


def main() -> None:
    parser = common.options(__doc__)
    parser.add_argument("--pairs", type=int, default=10_000, help="number of pairs")
    parser.add_argument("--processes", nargs="+", type=int, default=[2], help="numbers of processes")
    parser.add_argument("--dask", nargs="*", type=int, default=[2], help="numbers of Dask's local workers")
    chosen = parser.parse_args()
    if chosen.dask and find_spec("distributed") is None:
        parser.error('Dask is missing: pip install ".[distributed]", or give --dask without numbers')
    from fcslam.lidar.pair_verification import VerificationPool, verify_here

    report = common.Report(__file__, __doc__, chosen)
    setups = [("1", pool(0)), *((f"{count}", pool(count - 1)) for count in chosen.processes)]
    setups += [(f"1 and {count} of Dask", dask(count)) for count in chosen.dask]
    batches, rows, alone, expected = compared(chosen.pairs), [], {}, []
    at_once = {AT_ONCE: batches, chosen.pairs: [list(itertools.chain.from_iterable(batches))]}
    for name, setup in setups:
        with setup as executors:
            verify = VerificationPool(lambda executors=executors: executors) if executors else verify_here
            timed(verify, executors, batches[:8])
            for count, calls in at_once.items():
                took_s, cpu_s, found = timed(verify, executors, calls)
                expected = expected or found
                if found != expected:
                    raise SystemExit(f"verification: {name} finds something else")
                one_s, one_cpu_s = alone.setdefault(count, (took_s, cpu_s))
                a_pair_ms = 1e3 * took_s / chosen.pairs
                rows.append((name, count, chosen.pairs, took_s, a_pair_ms, one_s / took_s, one_cpu_s / cpu_s))
    report.table("Verification", COLUMNS, rows)
    report.write()


@contextmanager
def pool(count: int) -> Iterator[Sequence[Executor]]:
    """Processes beside this one."""
    with ExitStack() as stack:
        yield [stack.enter_context(ProcessPoolExecutor(1, get_context("spawn"))) for _ in range(count)]


@contextmanager
def dask(count: int) -> Iterator[Sequence[Executor]]:
    """Workers of a cluster on this machine, each a process as the scheduler is."""
    from fcslam.cluster.verifying import DaskCluster

    with tempfile.TemporaryDirectory() as folder, ExitStack() as stack:
        file = Path(folder) / "scheduler.json"
        where = ("--no-dashboard", "--scheduler-file", str(file))
        _start(stack, "scheduler", "--host", "127.0.0.1", "--port", "0", *where)
        while not file.exists():
            time.sleep(0.1)
        for _ in range(count):
            _start(stack, "worker", "--nthreads", "1", "--local-directory", folder, *where)
        time.sleep(5.0)
        with DaskCluster(json.loads(file.read_text())["address"]) as cluster:
            while len(cluster.executors()) < count:
                time.sleep(0.1)
            yield cluster.executors()


def _start(stack: ExitStack, kind: str, *options: str) -> None:
    command = [sys.executable, "-m", f"distributed.cli.dask_{kind}", *options]
    process = stack.enter_context(subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL))
    stack.callback(process.terminate)


def compared(count: int) -> list[list]:
    """Batches of pairs, ``count`` in all."""
    from fcslam.cloud.fleet import Fleet
    from fcslam.lab.simulation.noise import LidarSettings
    from fcslam.lab.simulation.simulated_fleet import SimulationSettings, simulate_fleet
    from fcslam.lidar.pair_verification import verify_here
    from fcslam.mission.mission import MissionConfig
    from fcslam.robot.frontend import RobotFrontend

    asked: list = []

    def keep(pairs):
        # The noise needs the scans of its mission, and is asked for too rarely to count.
        asked.extend(pair._replace(noise=lambda: 0.0) for pair in pairs)
        return verify_here(pairs)

    config = MissionConfig()
    fleet = Fleet(config.fleet, config.seed, keep)
    settings = SimulationSettings(robots=3, path_length_m=40.0, camera=None, lidar=LidarSettings(rate_hz=5.0))
    robots = [(RobotFrontend(robot.name, config.robot), robot) for robot in simulate_fleet(settings, 1).robots]
    sent = [[*itertools.chain(*map(front.process, robot.scans())), *front.finish()] for front, robot in robots]
    for packet in sorted(itertools.chain(*sent), key=lambda packet: packet.order):
        fleet.apply(packet)
    repeated = itertools.islice(itertools.cycle(asked), count)
    return [list(batch) for batch in iter(lambda: tuple(itertools.islice(repeated, AT_ONCE)), ())]


def timed(verify: Callable, executors: Sequence[Executor], batches: list[list]) -> tuple[float, float, list]:
    """Seconds, seconds of CPU of the busiest process, and what was found."""

    began, before_s = time.perf_counter(), used(executors)
    found = [check for batch in batches for check in verify(batch)]
    took_s = time.perf_counter() - began
    cpu_s = max(after - before for after, before in zip(used(executors), before_s, strict=True))
    return took_s, cpu_s, [(check.T_a_b.tobytes(), check.strict, check.loose) for check in found]


def used(executors: Sequence[Executor]) -> list[float]:
    """Seconds of CPU of this process and of each executor so far."""
    there = [executor.submit(time.process_time).result() for executor in executors]
    return [time.process_time(), *there]


if __name__ == "__main__":
    main()
