"""Keeps one worker process running, and starts it again when it dies."""

import json
import logging
import os
import subprocess
import sys
import threading
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Protocol

from fcslam.service.mission_folder import MissionFolder

LONGEST_PAUSE_S = 30.0
STEADY_S = 60.0
"""A worker that lived so long did not die of what it found at its start."""

READY = "ready"
"""The event by which a worker says that it waits for packets now; it is for the supervisor alone."""

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

    @property
    def is_ready(self) -> bool:
        """Whether it runs and has all its code at hand."""

    def ring(self) -> None:
        """Tell it that there is something to do."""

    def stop(self) -> None:
        """Let it end what it is doing, and wait for that."""


_log = logging.getLogger(__name__)


class Supervisor:
    """One worker at a time, until ``stop``."""

    def __init__(
        self, folder: MissionFolder, clock: Callable[[], float], listen: Listen,
        command: Sequence[str] = (sys.executable, "-m", "fcslam.service.worker"),
    ) -> None:  # fmt: skip
        """``command`` starts a worker when the mission's folder is added to it."""
        self._command = (*command, str(folder.path))
        self._clock, self._listen = clock, listen
        self._stopping = threading.Event()
        self._lock = threading.Lock()
        self._process: subprocess.Popen[bytes] | None = None
        self._starts = 0
        self._is_ready = False
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

    @property
    def is_ready(self) -> bool:
        """Whether the worker runs and has said that it is ready."""
        return self._is_ready and self.pid is not None

    def ring(self) -> None:
        """Tell the worker that there is something to do."""
        with self._lock:
            if self._process is not None and self._process.stdin is not None:
                # One that is gone is followed by one that looks for itself, and one that has not read its rings yet
                # (the pipe is full) knows that there is something.
                with suppress(OSError, ValueError):
                    self._process.stdin.write(b"\n")

    def stop(self) -> None:
        """Let the worker end what it is doing, and wait for that; one that is not ready yet does nothing."""
        self._stopping.set()
        with self._lock:
            self._end_input()
        self._thread.join()

    def _run(self) -> None:
        pause_s = 0.5
        while not self._stopping.is_set():
            began = self._clock()
            try:
                ended = f"ended with code {self._watch_one()}"
            except Exception as error:  # no program, no memory for it: that may pass
                ended = f"could not be run ({type(error).__name__}: {error})"
            if self._stopping.is_set():
                return
            pause_s = 0.5 if self._clock() - began > STEADY_S else min(2.0 * pause_s, LONGEST_PAUSE_S)
            _log.error("the worker %s; another one starts in %.0f s", ended, pause_s)
            self._stopping.wait(pause_s)

    def _watch_one(self) -> int:
        """Start a worker and pass on what it says, until it ends."""
        # Unbuffered: what a dead worker did not read must not turn up when the pipe is closed.
        with subprocess.Popen(self._command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, bufsize=0) as process:
            assert process.stdin is not None
            assert process.stdout is not None
            os.set_blocking(process.stdin.fileno(), False)
            with self._lock:
                self._process, self._is_ready = process, False
                self._starts += 1
                if self._stopping.is_set():
                    self._end_input()
            try:
                for line in process.stdout:
                    self._pass_on(line)
                return process.wait()
            finally:
                with self._lock:
                    self._process = None

    def _pass_on(self, line: bytes) -> None:
        try:
            told = json.loads(line)
            event, number = str(told["event"]), int(told["number"])
            if event == READY:
                self._is_ready = True
            else:
                self._listen(event, number)
        except (ValueError, TypeError, KeyError):
            _log.error("the worker says what nobody understands: %.200r", line)

    def _end_input(self) -> None:
        if self._process is not None and self._process.stdin is not None:
            with suppress(OSError):
                self._process.stdin.close()
            self._process.terminate()  # a worker that is ready ignores it
