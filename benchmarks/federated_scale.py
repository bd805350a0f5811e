"""A hundred robots train together, and a third of those that are asked never answer, or too late.

    python benchmarks/federated_scale.py [--robots 100] [--rounds 10] [--missing 0.3]

Needs fcslam[federated]. One server, and robots in four processes with a thread each, fetch requests over loopback (no
TLS). In each round the server asks 30 % of the robots, drawn anew.
Of those, a share is missing: half of these start again after the deadline, as after a loss of power, and half reply
after it. The weights have the size of the bundled detector. A robot's update is drawn by its name and the round:
training itself is the robots' own work.

The same fleet runs in one process too, where the missing robots fail at once. Both runs must make the same version in
every round. CPU is that of the server's process: requests, screening, merging and checkpoints.
"""

import argparse
import hashlib
import multiprocessing
import socket
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import common
import numpy as np

from fcslam.errors import InputError
from fcslam.learning.federated.client import Answer, InProcessFleet
from fcslam.learning.federated.coordinator import Coordinator, CoordinatorHooks, RoundRules, TrainingFleet
from fcslam.learning.federated.evaluation import PUBLIC_IMAGES
from fcslam.learning.federated.fleet_grid import FleetGrid
from fcslam.learning.federated.fleet_server import listening
from fcslam.learning.federated.initial_weights import read_detector_weights
from fcslam.learning.federated.messages import TrainingRequest
from fcslam.learning.federated.robot_learning import RobotLink, serve_requests
from fcslam.learning.federated.rounds import RoundReport
from fcslam.learning.federated.settings import FederatedSettings
from fcslam.learning.federated.weights import Weights
from fcslam.wire.keys import Server

DETECTOR = common.REPOSITORY / "src/fcslam/features/networks/detector.onnx"
PROCESSES = 4
PARTICIPATION = 0.3
DEADLINE_S = 15.0
LATE_S = 5.0
STEP = 0.002
"""Length of an update in relation to the weights."""
CONNECTING_S = 120.0

ROUNDS = {"round": "", "asked": "", "merged": "", "left out": "", "down, MB": ".1f", "up, MB": ".1f", "s": ".1f",
          "CPU of the server, s": ".1f", "as in one process": ""}  # fmt: skip
ALL = {"robots": "", "rounds": "", "missing of asked": ".0%", "merged": ".0%", "same versions": "",
       "CPU a round, s": ".2f", "CPU a robot asked, ms": ".0f", "peak of the server, MB": ".0f"}  # fmt: skip


@dataclass
class DrawnRobot:
    """A client that learns nothing; its update is a function of its name, the round and the weights."""

    name: str
    missing: float
    on_missing: Callable[["DrawnRobot", bool], None]
    """Called in a round in which the robot does not answer in time, with whether it is silent rather than late."""

    def __call__(self, request: TrainingRequest) -> Answer:
        rng = np.random.default_rng([*self.name.encode(), request.round_number])
        fate = rng.uniform()
        if fate < self.missing:
            self.on_missing(self, fate < self.missing / 2)
        return drawn_update(request.weights, rng, request.round_number), {"drawn": STEP}


def drawn_update(weights: Weights, rng: np.random.Generator, round_number: int) -> dict[str, Any]:
    """Weights a step further, in a direction that is half common to all robots; batch statistics stay."""
    common_rng = np.random.default_rng(round_number)
    new = {}
    for name, array in weights.items():
        if "running" in name:
            new[name] = array
            continue
        step = common_rng.normal(size=array.shape) + rng.normal(size=array.shape)
        new[name] = (array + STEP * np.sqrt(np.mean(array**2)) * step).astype(np.float32)
    return new


def version(weights: Weights) -> str:
    digest = hashlib.sha256()
    for name, array in sorted(weights.items()):
        digest.update(name.encode() + np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()[:12]


def main() -> None:
    parser = common.options(__doc__)
    parser.add_argument("--robots", type=int, default=100, help="size of the fleet")
    parser.add_argument("--rounds", type=int, default=10, help="number of rounds")
    parser.add_argument(
        "--missing", type=float, default=0.3, help="share of the asked robots that do not answer in time"
    )
    chosen = parser.parse_args()
    report = common.Report(__file__, __doc__, chosen)
    settings = FederatedSettings(rounds=chosen.rounds, participation=PARTICIPATION, deadline_s=DEADLINE_S)
    names = [f"robot-{number:03}" for number in range(chosen.robots)]
    alone = [found for found, _ in one_process(names, chosen.missing, settings)]
    deployed, peak_mb = over_a_network(names, chosen.missing, settings)
    report.table("Rounds", ROUNDS, [row(found, cpu, ref) for (found, cpu), ref in zip(deployed, alone, strict=True)])
    report.table("All", ALL, [total(chosen, deployed, alone, peak_mb)])
    report.write()
    if any(found.version != ref.version for (found, _), ref in zip(deployed, alone, strict=True)):
        sys.exit("the versions differ")


def one_process(names: list[str], missing: float, settings: FederatedSettings) -> list[tuple[RoundReport, float]]:
    """The reference."""
    return train(InProcessFleet({name: DrawnRobot(name, missing, fail) for name in names}), settings)


def fail(robot: DrawnRobot, _is_silent: bool) -> None:
    raise InputError(f"{robot.name} is missing")


def over_a_network(
    names: list[str], missing: float, settings: FederatedSettings
) -> tuple[list[tuple[RoundReport, float]], float]:
    """Rounds with their CPU seconds, and the server's largest resident set in MB."""
    grid = FleetGrid()
    with (
        socket.create_server(("127.0.0.1", 0)) as listener,
        listening(grid, listener),
        robots(names, missing, listener.getsockname()[1]),
    ):
        end = time.monotonic() + CONNECTING_S
        while len(grid.robots()) < len(names):
            if time.monotonic() > end:
                sys.exit(f"only {len(grid.robots())} of {len(names)} robots connected")
            time.sleep(0.2)
        return train(grid, settings), peak()


def train(grid: TrainingFleet, settings: FederatedSettings) -> list[tuple[RoundReport, float]]:
    """Every round with the CPU seconds of this process."""
    rounds: list[tuple[RoundReport, float]] = []
    spent = time.process_time()

    def note(report: RoundReport) -> None:
        nonlocal spent
        now = time.process_time()
        rounds.append((report, now - spent))
        spent = now

    hooks = CoordinatorHooks(version, lambda _: {PUBLIC_IMAGES: {"repeatability": 0.5, "mma_3px": 0.5}}, note)
    with tempfile.TemporaryDirectory() as folder:
        Coordinator(
            grid, settings, read_detector_weights(DETECTOR, "light"), Path(folder), hooks, RoundRules(judge_every=1)
        ).run()
    return rounds


@contextmanager
def robots(names: list[str], missing: float, port: int) -> Iterator[None]:
    """The robots, in processes of their own."""
    context = multiprocessing.get_context("spawn")
    processes = [
        context.Process(target=drive, args=(names[share::PROCESSES], missing, port), daemon=True)
        for share in range(PROCESSES)
    ]
    for process in processes:
        process.start()
    try:
        yield
    finally:
        for process in processes:
            process.kill()


def drive(names: list[str], missing: float, port: int) -> None:
    """Some robots in threads of this process, until it is killed."""
    threads = [threading.Thread(target=answer, args=(name, missing, port)) for name in names]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()


class PowerLossError(BaseException):
    """A robot is gone; nothing of fcslam catches it."""


def answer(name: str, missing: float, port: int) -> None:
    """One robot. It comes back some seconds after the deadline: a silent one starts again, a late one replies."""

    def stay_away(_robot: DrawnRobot, is_silent: bool) -> None:
        if is_silent:
            raise PowerLossError
        time.sleep(DEADLINE_S + LATE_S)

    client = DrawnRobot(name, missing, stay_away)
    while True:
        try:
            with closing(RobotLink(Server(f"http://127.0.0.1:{port}"), name)) as link:
                serve_requests(link, client, lambda _: None)
        except PowerLossError:
            time.sleep(DEADLINE_S + LATE_S)


def row(found: RoundReport, cpu_s: float, reference: RoundReport) -> tuple[Any, ...]:
    same = "yes" if found.version == reference.version else "NO"
    asked = len(found.robots) + len(found.left_out)
    return (found.round_number, asked, len(found.robots), len(found.left_out), found.bytes_down / 1e6,
            found.bytes_up / 1e6, found.seconds, cpu_s, same)  # fmt: skip


def total(
    chosen: argparse.Namespace, deployed: list[tuple[RoundReport, float]], alone: list[RoundReport], peak_mb: float
) -> tuple[Any, ...]:
    cpu_s = sum(cpu for _, cpu in deployed)
    merged = sum(len(found.robots) for found, _ in deployed)
    asked = merged + sum(len(found.left_out) for found, _ in deployed)
    same = sum(found.version == ref.version for (found, _), ref in zip(deployed, alone, strict=True))
    return (chosen.robots, chosen.rounds, chosen.missing, merged / asked, same, cpu_s / chosen.rounds,
            1e3 * cpu_s / asked, peak_mb)  # fmt: skip


def peak() -> float:
    """Largest resident set of this process, MB."""
    lines: Mapping[str, str] = dict(
        line.split(":", 1) for line in Path("/proc/self/status").read_text(encoding="ascii").splitlines()
    )
    return int(lines["VmHWM"].split()[0]) * 1024 / 1e6


if __name__ == "__main__":
    main()
