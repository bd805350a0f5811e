"""Keeps one worker process running, and starts it again when it dies."""

import json
import logging
import subprocess
import sys
import threading
from collections.abc import Callable, Sequence
from typing import Protocol

from fcslam.cloud.folder import MissionFolder

LONGEST_PAUSE_S = 30.0
STEADY_S = 60.0
"""A worker that lived so long did not die of what it found at its start."""

Listen = Callable[[str, int], None]
"""Is told of a worker's events; from a thread of its own."""


class RunningWorker(Protocol):
    """A worker, wherever it runs."""

    @property
    def pid(self) -> int | None:
        """Of its process; None while there is none."""

    @property
    def starts(self) -> int:
        """How often it was started."""

    def ring(self) -> None:
        """Tell it that there is something to do."""

    def stop(self) -> None:
        """Let it end what it is doing, and wait for that."""


_log = logging.getLogger(__name__)


class Supervisor:
    """One worker at a time, until ``stop``."""

    def __init__(self, folder: MissionFolder, clock: Callable[[], float], listen: Listen) -> None:
        self._command: Sequence[str] = (sys.executable, "-m", "fcslam.cloud.worker", str(folder.path))
        self._clock, self._listen = clock, listen
        self._stopping = threading.Event()
        self._lock = threading.Lock()
        self._process: subprocess.Popen[bytes] | None = None
        self._starts = 0
        self._thread = threading.Thread(target=self._run, name=f"worker of {folder.name}", daemon=True)
        self._thread.start()

    @property
    def pid(self) -> int | None:
        """Of the worker; None while there is none."""
        process = self._process
        return process.pid if process is not None and process.poll() is None else None

    @property
    def starts(self) -> int:
        """How often a worker was started."""
        return self._starts

    def ring(self) -> None:
        """Tell the worker that there is something to do."""
        with self._lock:
            if self._process is not None and self._process.stdin is not None:
                try:
                    self._process.stdin.write(b"\n")
                    self._process.stdin.flush()
                except OSError:
                    return  # it is gone, and the next one looks for itself

    def stop(self) -> None:
        """Let the worker end what it is doing, and wait for that."""
        self._stopping.set()
        with self._lock:
            if self._process is not None and self._process.stdin is not None:
                self._process.stdin.close()
        self._thread.join()

    def _run(self) -> None:
        pause_s = 0.5
        while not self._stopping.is_set():
            began = self._clock()
            code = self._watch_one()
            if self._stopping.is_set():
                return
            pause_s = 0.5 if self._clock() - began > STEADY_S else min(2.0 * pause_s, LONGEST_PAUSE_S)
            _log.error("the worker ended with code %s; another one starts in %.0f s", code, pause_s)
            self._stopping.wait(pause_s)

    def _watch_one(self) -> int:
        """Start a worker and pass on what it says, until it ends."""
        with subprocess.Popen(self._command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
            with self._lock:
                self._process = process
                self._starts += 1
                if self._stopping.is_set() and process.stdin is not None:
                    process.stdin.close()
            assert process.stdout is not None
            for line in process.stdout:
                told = json.loads(line)
                self._listen(told["event"], told["number"])
            code = process.wait()
            with self._lock:
                self._process = None
        return code
