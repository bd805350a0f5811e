"""The process in which the fleet of a service learns: ``python -m fcslam.learning.federated.fleet_learning``.

One thread runs the rounds. Another one follows the open mission and takes a released version back that turns out worse.
On stdout the process writes events as the worker of a mission does. It ends with its stdin.
"""

import argparse
import json
import logging
import os
import signal
import socket
import sys
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Final

import torch

from fcslam.errors import FcslamError
from fcslam.features.detector import BUNDLED_NETWORK
from fcslam.features.detector_file import describe_detector_file
from fcslam.learning.federated.artifacts import DETECTOR
from fcslam.learning.federated.gate import is_worse
from fcslam.learning.federated.history import RoundReport
from fcslam.learning.federated.initial_weights import prepare_initial_weights
from fcslam.learning.federated.job import FederatedJob, ProgressCallbacks, run_job
from fcslam.learning.federated.launch import open_port, waiting
from fcslam.learning.federated.live_settings import RELEASE, RELEASES, FleetLearningSettings
from fcslam.learning.federated.mission_places import MissionPlaces
from fcslam.learning.federated.networks import weights_version
from fcslam.learning.federated.releases import Releases
from fcslam.learning.federated.weights import Weights
from fcslam.learning.trainer import ExecutionOptions
from fcslam.service.http.authentication import Authenticator
from fcslam.service.mission_folder import MissionFolder
from fcslam.service.supervisor import READY

NICENESS: Final = 10
MISSION_EVERY_S: Final = 30.0
"""Time between two looks at the mission."""
_log = logging.getLogger("fcslam.learning")

Tell = Callable[[str, int], None]


@dataclass(slots=True)
class MissionJudge:
    """Follows the open mission and judges the version in use on it."""

    data: Path
    """The service's folder of missions."""
    settings: FleetLearningSettings
    releases: Releases
    tell: Tell
    _mission: MissionPlaces | None = None

    def step(self) -> None:
        """Look at the mission once.

        Raises:
            FcslamError: the mission cannot be read.
        """
        name = (self.data / "open").read_text(encoding="utf-8").strip()
        if self._mission is None or self._mission.folder.name != name:
            self._mission = MissionPlaces(MissionFolder(self.data / "missions" / name))
        if self._mission.follow() and self.releases.is_judged:
            self.judge(self._mission)

    def judge(self, mission: MissionPlaces) -> None:
        """Take the version in use back if it certainly finds fewer places than the one before."""
        number, earlier = self.releases.pair
        version, before = (self.releases.versions[each] for each in (number, earlier))
        loss = is_worse(mission.found_again(version, before), self.settings.gate, self.settings.federated.training.seed)
        if loss is not None:
            in_use = self.releases.take_back(number)
            _log.warning("%s finds fewer places than %s (%+.3f): taken back", version, before, loss.mean)
            self.tell(RELEASE, in_use)

    def run(self, stop: threading.Event) -> None:
        """Follow the mission until ``stop`` is set."""
        while not stop.wait(MISSION_EVERY_S):
            try:
                self.step()
            except (FcslamError, OSError) as error:  # the service may open another mission at this moment
                _log.error("the mission is not followed now: %s", error)


def run(data: Path, output: Path, settings: FleetLearningSettings, listener: socket.socket, tell: Tell) -> None:
    """Learn until all rounds are done, and judge the version in use as long as the process lives.

    Raises:
        TrainingError: the output folder belongs to other rounds.
        OutputError: the output folder cannot be written.
    """
    start = _announced(data)
    releases = Releases.opened(output / RELEASES, start.read_bytes(), describe_detector_file(start).version)
    judge = MissionJudge(data, settings, releases, tell)
    if releases.is_judged or releases.taken_back:
        tell(RELEASE, releases.in_use)
    encoder, options = settings.federated.training.encoder, ExecutionOptions(device="cpu", threads=1)
    initial = prepare_initial_weights(releases.detector(0), output, settings.federated, options, lambda *_: None)

    def release(weights: Weights) -> None:
        version = weights_version(weights, encoder)
        if version not in releases.versions:
            tell(RELEASE, releases.add(version, (output / DETECTOR).read_bytes(), weights))

    def report(done: RoundReport) -> None:
        decision = f"{done.version} is released" if done.released else "not released"
        if done.reason:
            _log.info("round %d: %s: %s", done.round_number, decision, done.reason)

    job = FederatedJob(
        output, settings.federated, releases.detector(0), gate=settings.gate,
        fallback=partial(releases.fallback, initial=initial),
    )  # fmt: skip
    told: set[str] = set()

    def say_once(line: str) -> None:
        if line not in told:
            told.add(line)
            _log.info("%s", line)

    everybody = Authenticator(None)  # the service has asked for the token
    with open_port(listener, None, everybody, say_once) as grid:
        stop = threading.Event()
        thread = threading.Thread(target=judge.run, args=(stop,), name="judge", daemon=True)
        thread.start()
        tell(READY, 0)
        run_job(job, options, ProgressCallbacks(rounds=report, released=release), grid, waiting(say_once))
        _log.info("all %d rounds are done; what is released stays judged", settings.federated.rounds)
        thread.join()


def _announced(data: Path) -> Path:
    """The file of the detector that the service announces, or the bundled one."""
    folder = data / "detectors" / "camera"
    named = folder / "announced"
    return folder / f"{named.read_text(encoding='utf-8')}.onnx" if named.is_file() else BUNDLED_NETWORK


def _tell(event: str, number: int) -> None:
    sys.stdout.write(json.dumps({"event": event, "number": number}) + "\n")
    sys.stdout.flush()


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
            run(given.data, given.output, given.settings, listener, _tell)
    except FcslamError as error:
        _log.error("%s", error)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
