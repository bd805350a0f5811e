"""The process in which a robot learns beside its mapping: ``python -m fcslam.learning.federated.robot_learning``.

It works only while the robot is idle, as its parent says on stdin: `idle` or `busy`. It ends with stdin. Its notices
are events for the parent. It reads the keyframes that the robot keeps on its disk, joins the rounds of the fleet, and
sends weights and reports on pairs of keyframes. Images never leave it.
"""

import argparse
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import closing
from pathlib import Path
from typing import Final

import torch

from fcslam.errors import FcslamError, InputError
from fcslam.learning.code_training import CodeInputs
from fcslam.learning.federated.client import RevisitClient
from fcslam.learning.federated.fleet_robot import RobotLink, serve_requests
from fcslam.learning.federated.learning_process import NOTICE
from fcslam.learning.federated.own_examples import own_examples
from fcslam.learning.federated.settings import RobotLearningSettings
from fcslam.processes import emit_event
from fcslam.wire.keys import Credentials, read_credentials

NICENESS: Final = 19
FRESH_S: Final = 20.0
"""Time for which the examples are not looked for again."""


class LearningRobot:
    """Lets a client work while the robot is idle and its budget lasts, on examples from its newest keyframes."""

    def __init__(
        self,
        folder: Path,
        client: RevisitClient,
        cpu_s: float,
        idle: threading.Event,
        notice: Callable[[str], None],
    ) -> None:
        """``folder``: of the keyframes; ``cpu_s``: the budget; ``idle``: set while the robot is idle."""
        self._folder, self._client, self._cpu_s, self._idle, self._notice = folder, client, cpu_s, idle, notice
        self._looked_s = float("-inf")
        self._seen = 0

    def pause(self, _robot: str = "", _steps: int = 0) -> None:
        """Before each step: wait while the robot is busy.

        Raises:
            InputError: the budget is spent.
        """
        if time.process_time() > self._cpu_s:
            raise InputError(f"the CPU time for learning is spent ({self._cpu_s:.0f} s)")
        self._idle.wait()

    def prepare(self) -> bool:
        """Before each request: look for new examples; returns whether there are any. Raises as ``pause``."""
        self.pause()
        if time.monotonic() - self._looked_s > FRESH_S:
            written = max((path.stat().st_mtime_ns for path in self._folder.glob("*.state")), default=0)
            if written != self._seen:
                self._seen = written
                revisits, held_out = own_examples(self._folder)
                self._client.revisits, self._client.held_out, self._client.inputs = revisits, held_out, CodeInputs()
                self._notice(
                    f"learns from {len(revisits.images)} images: {len(revisits.pairs)} pairs of its own; "
                    f"{len(held_out.revisits)} pairs held out"
                )
            self._looked_s = time.monotonic()
        return bool(self._client.revisits)


def _listen(idle: threading.Event) -> None:
    """Follow the parent; end with it."""
    for line in sys.stdin:
        if line.strip() == "idle":
            idle.set()
        else:
            idle.clear()
    os._exit(0)


def main(arguments: Sequence[str]) -> int:
    """Learn until the budget is spent or the parent ends."""
    parser = argparse.ArgumentParser()
    parser.add_argument("keyframes", type=Path)
    parser.add_argument("cache", type=Path)
    parser.add_argument("server")
    parser.add_argument("name")
    parser.add_argument("settings", type=RobotLearningSettings.model_validate_json)
    parser.add_argument("--credentials", type=Path)
    given = parser.parse_args(arguments)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent's
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    os.nice(NICENESS)
    torch.set_num_threads(1)
    idle, told = threading.Event(), ""
    threading.Thread(target=_listen, args=(idle,), daemon=True).start()

    def notice(line: str) -> None:
        nonlocal told
        if line != told:
            told = line
            emit_event(NOTICE, line)

    try:
        shown = Credentials() if given.credentials is None else read_credentials(given.credentials)
        client = RevisitClient(given.name, given.cache)
        robot = LearningRobot(given.keyframes, client, given.settings.cpu_s, idle, notice)
        client.on_step = robot.pause
        with closing(RobotLink(given.server, given.name, shown)) as link:
            serve_requests(link, client, notice, is_ready=robot.prepare)
    except (FcslamError, OSError) as error:
        notice(f"learning ends: {error}")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
