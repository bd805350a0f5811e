"""The process in which a robot learns beside its mapping: ``python -m fcslam.learning.federated.robot_learning``.

It works only while the robot is idle, as its parent says on stdin: `idle EPOCH` or `busy`; it ends with stdin. On
stdout it writes a line of JSON for each notice. It reads the keyframes that the robot keeps on its disk, joins the
rounds of the fleet, and sends weights and reports on pairs of keyframes. Images never leave it.
"""

import argparse
import hashlib
import json
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Final

import torch

from fcslam.errors import FcslamError, PacketError, TrainingError
from fcslam.learning.code_training import CodeInputs
from fcslam.learning.federated.client import RobotClient, secret_noise
from fcslam.learning.federated.client_app import build_client_app
from fcslam.learning.federated.fleet_robot import RobotLink, robot_context, serve_requests
from fcslam.learning.federated.live_settings import RobotLearningSettings
from fcslam.learning.federated.own_examples import own_examples
from fcslam.wire.batches import read_batch
from fcslam.wire.keys import read_token
from fcslam.wire.messages import Packet, TaughtPlace
from fcslam.wire.packets import decode

NICENESS: Final = 19
FRESH_S: Final = 20.0
"""Time for which the examples are not looked for again."""


class BusyRobotError(Exception):
    """The robot drives again; learning goes on when it is idle."""


class LearningEndError(Exception):
    """Learning has come to its end; the text says why."""


@dataclass(slots=True)
class Idleness:
    """Whether the robot is idle. One thread sets it, another one waits for it."""

    _changed: threading.Condition = field(default_factory=threading.Condition)
    _epoch: int | None = None

    def set(self, epoch: int | None) -> None:
        """Note the epoch of the robot's first session while it is idle, None while it is busy."""
        with self._changed:
            self._epoch = epoch
            self._changed.notify_all()

    @property
    def epoch(self) -> int | None:
        """None while the robot is busy."""
        return self._epoch

    def wait(self) -> int:
        """Wait until the robot is idle; returns the epoch."""
        with self._changed:
            while self._epoch is None:
                self._changed.wait()
            return self._epoch


class LearningRobot:
    """Joins rounds with a client while the robot is idle and its budget lasts."""

    def __init__(self, folder: Path, client: RobotClient, settings: RobotLearningSettings, idleness: Idleness) -> None:
        """``folder``: of the keyframes; ``client``: gets examples from there."""
        self._folder, self._client, self._settings, self._idleness = folder, client, settings, idleness
        self._looked_s = float("-inf")
        self._seen: tuple[object, ...] = ()

    def pause(self, _robot: str, _steps: int) -> None:
        """Between two steps: wait while the robot is busy.

        Raises:
            TrainingError: the budget is spent.
        """
        if time.process_time() > self._settings.cpu_s:
            raise TrainingError(f"{self._client.name} has spent its CPU time for learning")
        self._idleness.wait()

    def prepare(self, link: RobotLink) -> bool:
        """Before each request: look for new examples; returns whether there are any.

        Raises:
            BusyRobotError: the robot is busy.
            LearningEndError: the budget is spent.
            TrainingError, ConnectionError: as ``RobotLink.fetch``.
        """
        if time.process_time() > self._settings.cpu_s:
            raise LearningEndError(f"the CPU time for learning is spent ({self._settings.cpu_s:.0f} s)")
        epoch = self._idleness.epoch
        if epoch is None:
            raise BusyRobotError
        now = time.monotonic()
        if now - self._looked_s > FRESH_S:
            batch = link.taught()
            taught = checked_lessons(self._client.name, batch)
            written = max((path.stat().st_mtime_ns for path in self._folder.glob("*.state")), default=0)
            if (seen := (written, hashlib.sha256(batch).digest(), epoch)) != self._seen:
                self._look(taught, epoch)
                self._seen = seen
            self._looked_s = time.monotonic()
        return bool(self._client.revisits)

    def _look(self, taught: Sequence[Packet], epoch: int) -> None:
        examples = own_examples(self._folder, self._settings, taught, epoch)
        self._client.revisits, self._client.held_out = examples.revisits, examples.held_out
        self._client.inputs = CodeInputs()
        revisits = examples.revisits
        tell(
            f"learns from {len(revisits.images)} images: {len(revisits.pairs)} pairs of its own, "
            f"{len(revisits.taught)} taught, {len(revisits.voted)} with voted keypoints; "
            f"{len(examples.held_out.revisits)} pairs held out"
        )


class _IdleLink(RobotLink):
    """Asks for requests only while the robot is idle and has something to learn from."""

    def __init__(self, robot: LearningRobot, url: str, name: str, token: str | None, ca: Path | None,
                 own: tuple[Path, Path] | None) -> None:  # fmt: skip
        super().__init__(url, name, token, ca, own)
        self._robot = robot

    def fetch(self) -> tuple[int, bytes] | None:
        """As of a ``RobotLink``; BusyRobotError, LearningEndError: as ``LearningRobot.prepare``."""
        if not self._robot.prepare(self):
            time.sleep(1.0)
            return None
        return super().fetch()


def checked_lessons(robot: str, batch: bytes) -> list[Packet]:
    """The packets with codes for this robot.

    Raises:
        ConnectionError: these bytes are something else.
    """
    try:
        packets = [decode(data) for data in read_batch(batch)] if batch else []
    except PacketError as error:
        raise ConnectionError(f"the server teaches what cannot be read ({error})") from error
    if any(packet.robot != robot or not isinstance(packet.body, TaughtPlace) for packet in packets):
        raise ConnectionError("the server teaches places of another robot")
    return packets


def learn(open_link: Callable[[], RobotLink], client: RobotClient, idleness: Idleness) -> str:
    """Join rounds until learning ends; returns why.

    Raises:
        TrainingError: the server does not accept the robot.
        CloudError: the server's address or certificate cannot be used.
    """
    app, context = build_client_app(lambda _context: client), robot_context()
    told = ""

    def notice(line: str) -> None:
        nonlocal told
        if line != told:
            told = line
            tell(line)

    while True:
        idleness.wait()
        try:
            with open_link() as link:
                serve_requests(link, app, context, notice)
        except BusyRobotError:
            continue
        except LearningEndError as end:
            return str(end)


def tell(line: str) -> None:
    """Write a notice for the parent."""
    sys.stdout.write(json.dumps({"notice": line}) + "\n")
    sys.stdout.flush()


def _listen(idleness: Idleness) -> None:
    """Follow the parent; end with it."""
    for line in sys.stdin:
        word, _, epoch = line.strip().partition(" ")
        idleness.set(int(epoch) if word == "idle" and epoch.isdecimal() else None)
    os._exit(0)


def main(arguments: Sequence[str]) -> int:
    """Learn until the budget is spent or the parent ends."""
    parser = argparse.ArgumentParser()
    parser.add_argument("keyframes", type=Path)
    parser.add_argument("cache", type=Path)
    parser.add_argument("server")
    parser.add_argument("name")
    parser.add_argument("settings", type=RobotLearningSettings.model_validate_json)
    for file in ("token-file", "ca", "certificate", "key"):
        parser.add_argument(f"--{file}", type=Path)
    given = parser.parse_args(arguments)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent's
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    os.nice(NICENESS)
    torch.set_num_threads(1)
    idleness = Idleness()
    threading.Thread(target=_listen, args=(idleness,), daemon=True).start()
    try:
        token = None if given.token_file is None else read_token(given.token_file)
        own = None if given.certificate is None else (given.certificate, given.key)
        client = RobotClient(given.name, given.keyframes, given.cache, secret_noise)
        robot = LearningRobot(given.keyframes, client, given.settings, idleness)
        client.on_step = robot.pause
        link = partial(_IdleLink, robot, given.server, given.name, token, given.ca, own)
        tell(f"learning ends: {learn(link, client, idleness)}")
    except (FcslamError, OSError) as error:
        tell(f"learning ends: {error}")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
