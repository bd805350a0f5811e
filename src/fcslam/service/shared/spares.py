"""Workers that have compiled their code before there is a mission for them: so a mission is taken over in no time."""

import json
import subprocess
import threading
from collections.abc import Sequence
from contextlib import suppress
from typing import Final

from fcslam.service.supervisor import SPARE, WORKER, start_worker

KEPT: Final = 2
"""Spare workers that an instance keeps."""


class Spares:
    """Starts workers: a spare one if there is one, and a new spare one in its place. Any thread may call."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._is_closed = False
        self._waiting = [self._new() for _ in range(KEPT)]

    def start(self, arguments: Sequence[str]) -> subprocess.Popen[bytes]:
        """Let a worker begin with these arguments."""
        with self._lock:
            process = next((spare for spare in self._waiting if spare.poll() is None), None)
            self._waiting = [spare for spare in self._waiting if spare is not process and spare.poll() is None]
            if process is not None and not self._is_closed:
                self._waiting.append(self._new())
        process = process or self._new()
        assert process.stdin is not None
        with suppress(OSError):  # it died now, which its supervisor sees
            process.stdin.write(json.dumps(list(arguments)).encode() + b"\n")
        return process

    def close(self) -> None:
        """End the spare workers."""
        with self._lock:
            self._is_closed = True
            for spare in self._waiting:
                spare.terminate()  # one that waits for a mission ignores it, and ends with its input
                spare.communicate()
            self._waiting = []

    @staticmethod
    def _new() -> subprocess.Popen[bytes]:
        return start_worker((*WORKER, SPARE))
