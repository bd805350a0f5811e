"""Keeps one worker process running, and starts it again when it dies."""

import json
import logging
import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, Protocol

from fcslam.cloud.stage_times import StageTotal

LONGEST_PAUSE_S = 30.0
STEADY_S = 60.0
"""Seconds after which a worker's crash is not blamed on its start."""

READY = "ready"
"""The event by which a worker reports that it is ready; the supervisor does not pass it on."""

PROGRESS = "progress"
"""The event by which a worker reports how many packets it has applied; the supervisor keeps the number."""

STAGE_RUNS, STAGE_MS = "runs of ", "ms of "
"""Before the name of a stage: the events by which a worker reports how often it ran, and how many milliseconds it took
in all. The supervisor keeps the numbers."""


def tell(event: str, number: int) -> None:
    """Write an event of this worker to stdout, where its supervisor reads it."""
    sys.stdout.write(json.dumps({"event": event, "number": number}) + "\n")
    sys.stdout.flush()


class RunningWorker(Protocol):
    """A worker, wherever it runs."""

    @property
    def pid(self) -> int | None:
        """Process id; None while there is no process."""

    @property
    def starts(self) -> int:
        """How often it was started."""

    @property
    def is_ready(self) -> bool:
        """Whether it runs and has compiled its code."""

    @property
    def applied(self) -> int:
        """How many packets the present worker has applied, those of its snapshot included."""

    @property
    def stages(self) -> Mapping[str, StageTotal]:
        """Totals of the present worker's stages, by name."""

    def notify(self) -> None:
        """Notify the worker of new packets or requests."""

    def stop(self) -> None:
        """Stop the worker after its current step, and wait."""


WORKER = (sys.executable, "-m", "fcslam.service.worker")
"""The command that starts a worker."""

SPARE = "--spare"
"""The only argument of a worker that gets its other arguments later, as a line of JSON on stdin."""

_log = logging.getLogger(__name__)


def start_worker(command: Sequence[str]) -> subprocess.Popen[bytes]:
    """Start a worker with pipes to its input and output."""
    # Unbuffered: what a dead worker did not read must not turn up when the pipe is closed.
    return subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, bufsize=0)


class Supervisor:
    """One worker at a time, until ``stop``."""

    def __init__(
        self,
        folder: Path,
        listen: Callable[[str, int], None],
        command: Sequence[str] = WORKER,
        start: Callable[[Sequence[str]], subprocess.Popen[bytes]] = start_worker,
    ) -> None:
        """``listen`` is called with the worker's events, on a separate thread. ``start`` makes a process of
        ``command``, to which the folder, of a mission for instance, is added.
        """
        self._command, self._start = (*command, str(folder)), start
        self._listen = listen
        self._stopping = threading.Event()
        self._lock = threading.Lock()
        self._process: subprocess.Popen[bytes] | None = None
        self._is_ready = False
        self.starts, self.applied = 0, 0
        self.stages: Mapping[str, StageTotal] = {}
        self._thread = threading.Thread(target=self._run, name=f"worker of {folder.name}", daemon=True)
        self._thread.start()

    @property
    def pid(self) -> int | None:
        """As in ``RunningWorker``."""
        process = self._process
        return process.pid if process is not None and process.poll() is None else None

    @property
    def is_ready(self) -> bool:
        """As in ``RunningWorker``."""
        return self._is_ready and self.pid is not None

    def notify(self) -> None:
        """As in ``RunningWorker``."""
        with self._lock:
            if self._process is not None and self._process.stdin is not None:
                # One that is gone is followed by one that looks for itself, and one that has not read its rings yet
                # (the pipe is full) knows that there is something.
                with suppress(OSError, ValueError):
                    self._process.stdin.write(b"\n")

    def stop(self) -> None:
        """Stop the worker after its current step, and wait; a worker that still compiles stops at once."""
        self._stopping.set()
        with self._lock:
            self._end_input()
        self._thread.join()

    def _run(self) -> None:
        pause_s = 0.5
        while not self._stopping.is_set():
            began = time.monotonic()
            try:
                ended = f"ended with code {self._watch_one()}"
            except Exception as error:  # no program, no memory for it: that may pass
                ended = f"could not be run ({type(error).__name__}: {error})"
            if self._stopping.is_set():
                return
            pause_s = 0.5 if time.monotonic() - began > STEADY_S else min(2.0 * pause_s, LONGEST_PAUSE_S)
            _log.error("the worker %s; another one starts in %.0f s", ended, pause_s)
            self._stopping.wait(pause_s)

    def _watch_one(self) -> int:
        """Start a worker and pass on its events until it ends."""
        with self._start(self._command) as process:
            assert process.stdin is not None
            assert process.stdout is not None
            os.set_blocking(process.stdin.fileno(), False)
            with self._lock:
                self._process, self._is_ready = process, False
                self.starts, self.applied, self.stages = self.starts + 1, 0, {}
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
            message = json.loads(line)
            event, number = str(message["event"]), int(message["number"])
            if event == READY:
                self._is_ready = True
            elif event == PROGRESS:
                self.applied = number
            elif event.startswith(STAGE_RUNS):
                self._note_stage(event.removeprefix(STAGE_RUNS), runs=number)
            elif event.startswith(STAGE_MS):
                self._note_stage(event.removeprefix(STAGE_MS), seconds=1e-3 * number)
            else:
                self._listen(event, number)
        except (ValueError, TypeError, KeyError):
            _log.error("unreadable event of the worker: %.200r", line)

    def _note_stage(self, stage: str, **change: Any) -> None:
        self.stages = {**self.stages, stage: self.stages.get(stage, StageTotal(0, 0.0))._replace(**change)}

    def _end_input(self) -> None:
        if self._process is not None and self._process.stdin is not None:
            with suppress(OSError):
                self._process.stdin.close()
            self._process.terminate()  # a worker that is ready ignores it
