"""Verification of closures on a pool of processes: 10,000 pairs, one process against two.

    python benchmarks/verification.py [--pairs 10000]

The pairs are those that a mission of simulated robots in one building compares, again and again until they are enough.
A batch has as many as there are places to compare while the fleet is small (`fleet.matcher.small_fleet`). One process
is this one; of two, this one and another share the pairs. The pool is started and has loaded its code before the clock
runs. Wall-clock time: the machine must be quiet. The last column needs no quiet machine: CPU of one process, against
that of the busiest.
"""

import itertools
import time
from concurrent.futures import ProcessPoolExecutor
from contextlib import ExitStack
from multiprocessing import get_context

import common

AT_ONCE = 150
SUBMAPS_KEPT = 300
COLUMNS = {"processes": "", "pairs": ",", "time, s": ".1f", "a pair, ms": ".2f", "against one": ".2f", "by CPU": ".2f"}


def main() -> None:
    parser = common.options(__doc__)
    parser.add_argument("--pairs", type=int, default=10_000, help="number of pairs")
    parser.add_argument("--processes", nargs="+", type=int, default=[2], help="numbers of processes")
    chosen = parser.parse_args()
    report = common.Report(__file__, __doc__, chosen)
    batches = compared(chosen.pairs)
    single_s, single_cpu_s, expected = timed([], batches)
    rows = [(1, chosen.pairs, single_s, 1e3 * single_s / chosen.pairs, 1.0, 1.0)]
    for processes in chosen.processes:
        with ExitStack() as stack:
            pools = [ProcessPoolExecutor(1, get_context("spawn")) for _ in range(processes - 1)]
            executors = [stack.enter_context(pool) for pool in pools]
            timed(executors, batches[:4])
            pool_s, cpu_s, found = timed(executors, batches)
        if found != expected:
            raise SystemExit("verification: the pool finds something else")
        a_pair_ms = 1e3 * pool_s / chosen.pairs
        rows.append((processes, chosen.pairs, pool_s, a_pair_ms, single_s / pool_s, single_cpu_s / cpu_s))
    report.table("Verification", COLUMNS, rows)
    report.write()


def compared(count: int) -> list[list]:
    """Batches of pairs, ``count`` in all."""
    from fcslam.cloud.fleet import Fleet
    from fcslam.lidar.pair_verification import verify_here
    from fcslam.mission import MissionConfig
    from fcslam.robot.frontend import RobotFrontend
    from fcslam.simulation.noise import LidarSettings
    from fcslam.simulation.simulated_fleet import SimulationSettings, simulate_fleet

    asked: list = []

    def keep(pairs, config):
        # The noise needs the scans of its mission, and is asked for too rarely to count.
        asked.extend(pair._replace(noise=lambda: 0.0) for pair in pairs)
        return verify_here(pairs, config)

    config = MissionConfig()
    fleet = Fleet(config.fleet, config.seed, keep)
    settings = SimulationSettings(robots=3, path_length_m=40.0, camera=None, lidar=LidarSettings(rate_hz=5.0))
    robots = [(RobotFrontend(robot.name, config.robot), robot) for robot in simulate_fleet(settings, 1).robots]
    sent = [[*itertools.chain(*map(front.process, robot.scans())), *front.finish()] for front, robot in robots]
    for packet in sorted(itertools.chain(*sent), key=lambda packet: packet.order):
        fleet.apply(packet)
    repeated = itertools.islice(itertools.cycle(asked), count)
    return [list(batch) for batch in iter(lambda: tuple(itertools.islice(repeated, AT_ONCE)), ())]


def timed(executors: list, batches: list[list]) -> tuple[float, float, list]:
    """Seconds, seconds of CPU of the busiest process, and what was found."""
    from fcslam.lidar.pair_verification import VerificationPool, verify_here
    from fcslam.lidar.verification import VerificationConfig

    run = VerificationPool(executors, SUBMAPS_KEPT) if executors else verify_here
    config, began, before_s = VerificationConfig(), time.perf_counter(), used(executors)
    found = [check for batch in batches for check in run(batch, config)]
    took_s = time.perf_counter() - began
    cpu_s = max(after - before for after, before in zip(used(executors), before_s, strict=True))
    return took_s, cpu_s, [(check.T_a_b.tobytes(), check.strict, check.loose) for check in found]


def used(executors: list) -> list[float]:
    """Seconds of CPU of this process and of each executor so far."""
    there = [executor.submit(time.process_time).result() for executor in executors]
    return [time.process_time(), *there]


if __name__ == "__main__":
    main()
