"""Federated training deployed for real, a robot killed amid a round; and what rounds cost beside training.

    python benchmarks/federated_deployed.py

Needs fcslam[federated]; images are drawn. Five robots and a server, each a command of a user, train for a few steps on
this machine. One robot is killed (SIGKILL) while it trains in the first round and
never comes back. The same run in one process, without that robot, must end in the same bytes.

Then one process trains with the default settings, five robots of 5 images each, and the processor's time is split:
what the robots' training legs take, what judging takes, and the rest, which is the fleet's: Flower's records,
screening, merging, checkpoints, versions. The rest does not depend on the number of steps; its share at the default
number follows.
"""

import csv
import os
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import common
import cv2
import numpy as np

import fcslam

ENVIRONMENT = {**os.environ, "PYTHONPATH": str(Path(fcslam.__file__).parents[1])}
ROBOTS = ("a", "b", "c", "d", "e")
KILLED = ROBOTS[-1]
PATIENCE_S = 1800.0
TINY = """rounds: 2
local_steps: 4
minimum_robots: 4
training: {shape_steps: 2, pairs: 1, side_px: 96, label_copies: 1}
"""
ROUNDS = {"round": "", "robots": "", "left out": "", "up, MB": ".2f", "down, MB": ".2f", "deployed, s": ".0f",
          "one process, s": ".1f", "same version": ""}  # fmt: skip
COST = {"CPU of": "", "s a round": ".2f", "share of training": ".1%"}


def drawn(folder: Path, count: int, seed: int, side: tuple[int, int] = (320, 240)) -> Path:
    """Pictures with corners everywhere: rectangles of random shades."""
    folder.mkdir(parents=True)
    rng = np.random.default_rng(seed)
    for number in range(count):
        picture = np.full(side[::-1], 128, np.uint8)
        for corner in rng.integers(0, side, (300, 2)):
            far = corner + rng.integers(6, 40, 2)
            cv2.rectangle(picture, corner.tolist(), far.tolist(), int(rng.integers(256)), -1)
        cv2.imwrite(str(folder / f"{number}.png"), cv2.GaussianBlur(picture, (3, 3), 0))
    return folder


@contextmanager
def federate(*words: object, log: Path) -> Iterator["subprocess.Popen[bytes]"]:
    """A command in the background, interrupted at the end of the block."""
    command = [sys.executable, "-m", "fcslam.cli", "tools", "federate", *map(str, words)]
    with log.open("wb") as file:
        process = subprocess.Popen(
            command,
            env=ENVIRONMENT,
            stdout=file,
            stderr=file,
            preexec_fn=heed_interrupts,  # noqa: PLW1509
        )
    try:
        yield process
    finally:
        process.send_signal(signal.SIGINT)
        process.wait(180.0)


def heed_interrupts() -> None:
    """A benchmark in the background ignores them, and what it starts would as well."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)


def wait_for(happened: Callable[[], bool], what: str, log: Path) -> None:
    end = time.monotonic() + PATIENCE_S
    while not happened():
        if time.monotonic() > end:
            sys.exit(f"{what} did not happen:\n{log.read_text()}")
        time.sleep(0.05)


def free_port() -> int:
    """A port of this machine on which no process listens."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def deploy(folder: Path, options: Sequence[object]) -> Path:
    """Server and robots in processes of their own; one robot is killed while it trains."""
    from contextlib import ExitStack

    where, output, log = f"127.0.0.1:{free_port()}", folder / "deployed", folder / "server.log"
    with ExitStack() as running:
        server = running.enter_context(federate("serve", where, "-o", output, *options, "--insecure", log=log))
        wait_for(lambda: "waiting: 0 robots" in log.read_text(), "the server's start", log)
        robots = {}
        for robot in ROBOTS:
            words = ["join", f"http://{where}", folder / robot, "-o", folder / f"home-{robot}"]
            robots[robot] = running.enter_context(federate(*words, log=folder / f"{robot}.log"))
        # It labels its images when the first order to train has come.
        labels = folder / f"home-{KILLED}" / "labels"
        wait_for(labels.exists, "the first order", log)
        robots[KILLED].kill()
        wait_for(lambda: server.poll() is not None, "the server's end", log)
    if server.returncode:
        sys.exit(log.read_text())
    return output


def rounds(folder: Path) -> list[dict[str, str]]:
    with (folder / "rounds.csv").open(newline="") as file:
        return list(csv.DictReader(file))


def weights(folder: Path) -> list[tuple[str, bytes]]:
    """All arrays of weights in the checkpoint, and the server's momentum, as bytes."""
    with np.load(folder / "checkpoint.npz") as file:
        return [(name, file[name].tobytes()) for name in sorted(file.files) if name.partition("/")[1]]


def compare(report: common.Report, folder: Path) -> None:
    """The deployed run beside the one in a process."""
    for seed, robot in enumerate(ROBOTS):
        drawn(folder / robot, 3, seed)
    (folder / "tiny.yaml").write_text(TINY)
    options = ["--config", folder / "tiny.yaml", "--public", drawn(folder / "public", 4, 99)]
    embedded, rest = folder / "embedded", [folder / robot for robot in ROBOTS if robot != KILLED]
    common.run_fcslam("tools", "federate", "local", *rest, "-o", embedded, *options)
    began = time.perf_counter()
    deployed = deploy(folder, options)
    wall_s = time.perf_counter() - began
    rows = [
        (there["round"], there["robots"].replace(" | ", " "), there["left_out"], int(there["bytes_up"]) / 1e6,
         int(there["bytes_down"]) / 1e6, float(there["seconds"]), float(here["seconds"]),
         "yes" if there["version"] == here["version"] else "no")
        for there, here in zip(rounds(deployed), rounds(embedded), strict=True)
    ]  # fmt: skip
    report.table("Rounds of five robots, one killed in the first", ROUNDS, rows)
    arrays = weights(deployed)
    same = bool(arrays) and arrays == weights(embedded)
    files = (deployed / "detector.onnx").read_bytes() == (embedded / "detector.onnx").read_bytes()
    report.say(
        f"From the first command to the end {wall_s:.0f} s. {len(arrays)} arrays of weights, byte by byte those of one "
        f"process without robot {KILLED}: {'yes' if same else 'NO'}; the detector's file: {'yes' if files else 'NO'}."
    )


class Stopwatch:
    """The processor's time that calls take, those of threads included."""

    def __init__(self) -> None:
        self.spent_s = 0.0

    def around(self, call: Callable[..., Any]) -> Callable[..., Any]:
        def timed(*arguments: Any, **named: Any) -> Any:
            began = time.process_time()
            try:
                return call(*arguments, **named)
            finally:
                self.spent_s += time.process_time() - began

        return timed


def overhead(report: common.Report, folder: Path, steps: int, count: int) -> None:
    """What a round takes beside training."""
    from functools import partial

    import torch

    from fcslam.learning.federated import client
    from fcslam.learning.federated.coordinator import Coordinator, CoordinatorHooks, RoundRules
    from fcslam.learning.federated.fleets import InProcessFleet
    from fcslam.learning.federated.messages import TrainingRequest
    from fcslam.learning.federated.networks import network_to_weights, weights_version
    from fcslam.learning.federated.public_images import public_evaluation, read_public_images
    from fcslam.learning.federated.settings import FederatedSettings
    from fcslam.learning.network import KeypointNetwork
    from fcslam.learning.settings import TrainingSettings

    torch.set_num_threads(1)
    torch.manual_seed(1)
    training = TrainingSettings(label_copies=1)
    settings = FederatedSettings(local_steps=steps, rounds=count, training=training)
    fleet = [
        client.RobotClient(name, drawn(folder / name, 5, seed), folder / "labels" / name)
        for seed, name in enumerate(ROBOTS)
    ]
    start = network_to_weights(KeypointNetwork("light"))
    for each in fleet:
        # Labels, and what torch does first.
        once = settings.model_copy(update={"local_steps": 1})
        each.train(TrainingRequest(True, start, "", 0, "first", "images", once))
    training_time, evaluation_time = Stopwatch(), Stopwatch()
    evaluate = public_evaluation(read_public_images([drawn(folder / "public", 4, 99)]), "light", "cpu")
    hooks = CoordinatorHooks(partial(weights_version, encoder="light"), evaluation_time.around(evaluate))
    local_training, client.local_training = client.local_training, training_time.around(client.local_training)
    began = time.process_time()
    Coordinator(InProcessFleet(fleet), settings, start, folder / "run", hooks, RoundRules(judge_every=1)).run()
    total_s = time.process_time() - began
    client.local_training = local_training
    rest_s = (total_s - training_time.spent_s - evaluation_time.spent_s) / count
    local_s, default = training_time.spent_s / count, FederatedSettings().local_steps
    report.table(f"Processor time of a round, {len(fleet)} robots, {steps} steps each, mean of {count}", COST, [
        ("training legs", local_s, 1.0),
        ("the fleet around them", rest_s, rest_s / local_s),
        ("judging on 24 pairs", evaluation_time.spent_s / (count + 1), evaluation_time.spent_s / (count + 1) / local_s),
        (f"the fleet around the default {default} steps", rest_s, rest_s / local_s * steps / default),
    ])  # fmt: skip


def main() -> None:
    parser = common.options(__doc__)
    parser.add_argument("--steps", type=int, default=10, help="of a robot in a round, where processor time is measured")
    chosen = parser.parse_args()
    try:
        import flwr  # noqa: F401
        import torch  # noqa: F401
    except ImportError:
        print("skipped: needs fcslam[federated]")
        return
    report = common.Report(__file__, __doc__, chosen)
    with tempfile.TemporaryDirectory() as place:
        compare(report, Path(place) / "fleet")
        overhead(report, Path(place) / "cost", chosen.steps, 3)
    report.write()


if __name__ == "__main__":
    main()
