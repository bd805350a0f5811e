"""The process in which the fleet of a service learns: ``python -m fcslam.learning.federated.fleet_learning``.

On stdout the process writes events as the worker of a mission does. It ends with its stdin.
"""

import argparse
import logging
import os
import signal
import socket
import sys
import threading
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Final

import torch

from fcslam.errors import FcslamError, writing
from fcslam.features.detector import BUNDLED_NETWORK
from fcslam.learning.federated.coordinator import RoundRules
from fcslam.learning.federated.fleet_grid import FleetGrid
from fcslam.learning.federated.fleet_server import RETRY_S, listening
from fcslam.learning.federated.job import FederatedJob, run_job
from fcslam.learning.federated.rounds import RoundReport
from fcslam.learning.federated.settings import RELEASE, FleetLearningSettings
from fcslam.processes import NICENESS, emit_event
from fcslam.service.supervisor import READY
from fcslam.storage.files import write_file

START: Final = "start.onnx"
"""The detector from which training started, in the output folder."""
_log = logging.getLogger("fcslam.learning")


def run(data: Path, output: Path, settings: FleetLearningSettings, listener: socket.socket) -> None:
    """Learn until all rounds are done, and live on."""
    told: set[str] = set()

    def report(done: RoundReport) -> None:
        if done.evaluation.reason:
            decision = f"{done.version} is released" if done.released else "not released"
            _log.info("round %d: %s: %s", done.round_number, decision, done.evaluation.reason)

    def wait(reason: str) -> None:
        if reason not in told:
            told.add(reason)
            _log.info("waiting: %s", reason)
        time.sleep(RETRY_S)  # the round is tried again

    job = FederatedJob(
        output, settings.federated, _start(data, output), rules=RoundRules(fewest_pairs=settings.fewest_pairs)
    )
    grid = FleetGrid()
    with listening(grid, listener):
        emit_event(READY, None)
        run_job(job, grid, on_round=report, on_release=lambda _weights: emit_event(RELEASE, None), wait=wait)
        _log.info("all %d rounds are done", settings.federated.rounds)
        threading.Event().wait()


def _start(data: Path, output: Path) -> Path:
    """The detector from which training starts: a copy of the one announced at the first start, or the bundled one."""
    kept, folder = output / START, data / "detectors" / "camera"
    named = folder / "announced"
    with writing(kept, "free disk space"):
        if not kept.exists():
            output.mkdir(parents=True, exist_ok=True)
            file = folder / f"{named.read_text(encoding='utf-8')}.onnx" if named.is_file() else BUNDLED_NETWORK
            write_file(kept, file.read_bytes())
    return kept


def _end_with_stdin() -> None:
    # Not by sys.stdin, whose lock Python waits for when the process ends.
    while os.read(0, 4096):
        pass
    os._exit(0)


def main(arguments: Sequence[str]) -> int:
    """Run until stdin ends."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--listener", type=Path, required=True)
    parser.add_argument("--settings", type=FleetLearningSettings.model_validate_json, required=True)
    parser.add_argument("--output", type=Path, required=True)
    parser.add_argument("data", type=Path)
    given = parser.parse_args(arguments)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    os.nice(NICENESS)
    torch.set_num_threads(1)
    logging.basicConfig(level=logging.INFO, format="%(levelname)s %(name)s: %(message)s")
    threading.Thread(target=_end_with_stdin, daemon=True).start()
    given.listener.unlink(missing_ok=True)  # of a process before that was killed
    try:
        with socket.socket(socket.AF_UNIX) as listener:
            listener.bind(str(given.listener))
            listener.listen()
            run(given.data, given.output, given.settings, listener)
    except FcslamError as error:
        _log.error("%s", error)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
