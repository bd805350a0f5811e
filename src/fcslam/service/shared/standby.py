"""Workers that have compiled their code before there is a mission for them: so a mission is taken over in no time."""

import json
import threading
from collections import deque
from collections.abc import Sequence
from typing import Final

from fcslam.processes import Child, module_command
from fcslam.service.supervisor import STANDBY, WORKER

KEPT: Final = 2
"""Standby workers that an instance keeps."""


class StandbyWorkers:
    """Starts workers: one that stands by if there is one, and a new one in its place. Any thread may call."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._is_closed = False
        self._waiting = [_new() for _ in range(KEPT)]

    def start(self, arguments: Sequence[str]) -> Child:
        """Let a worker begin with these arguments."""
        with self._lock:
            alive = [worker for worker in self._waiting if worker.pid is not None]
            worker, self._waiting = (alive[0], alive[1:]) if alive else (_new(), [])
            while len(self._waiting) < KEPT and not self._is_closed:
                self._waiting.append(_new())
        worker.send(json.dumps(list(arguments)))
        return worker

    def close(self) -> None:
        """End the standby workers."""
        with self._lock:
            self._is_closed = True
            for worker in self._waiting:
                worker.stop()
            for worker in self._waiting:
                deque(worker.events(), 0)
                worker.wait()
            self._waiting = []


def _new() -> Child:
    return Child(module_command(WORKER, STANDBY))
