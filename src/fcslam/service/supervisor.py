"""Keeps one process running, and starts it again when it dies."""

import json
import logging
import threading
import time
from collections import deque
from collections.abc import Callable
from typing import Any, NamedTuple

from fcslam.processes import Child, module_command

LONGEST_PAUSE_S = 30.0
"""Longest pause before another start. The first one is a second, and each one twice as long as that before. After a
worker that ran for longer than this, it is a second again."""
READY = "ready"
"""The event by which a worker reports that it is ready."""
PROGRESS = "progress"
"""The event by which a worker reports how many packets it has applied."""
WORKER = "fcslam.service.worker"
"""The module of workers."""
STANDBY_WORKERS = 2
"""Standby workers that an instance keeps."""
_log = logging.getLogger(__name__)


class WorkerTask(NamedTuple):
    """What a worker is told on its stdin, as a line of JSON."""

    folder: str
    """Folder of the mission."""
    workers: str = "1"
    """Who verifies closures (``cluster.verifying``)."""
    store: str | None = None
    """Address of the database; None: the mission is a file."""
    lease: tuple[int, int] | None = None
    """The mission's number in the database, and the fence."""


def start_worker(task: WorkerTask) -> Child:
    """Start the worker of a mission."""
    worker = _new_worker()
    worker.send(json.dumps(task._asdict()))
    return worker


def _new_worker() -> Child:
    return Child(module_command(WORKER))


class Supervisor:
    """One worker at a time, until ``stop``."""

    def __init__(
        self,
        name: str,
        start: Callable[[], Child],
        listen: Callable[[str, Any], None],
        longest_pause_s: float = LONGEST_PAUSE_S,
    ) -> None:
        """``start`` starts a worker. ``listen`` is called on a separate thread with those events of a worker, and their
        contents, that the supervisor does not keep itself.
        """
        self._start, self._listen, self._longest_pause_s = start, listen, longest_pause_s
        self._stopping = threading.Event()
        self._lock = threading.Lock()
        self._child: Child | None = None
        self._is_ready = False
        self.starts, self.applied = 0, 0
        """How often a worker was started, and how many packets the present one has applied."""
        self._thread = threading.Thread(target=self._run, name=f"worker of {name}", daemon=True)
        self._thread.start()

    @property
    def pid(self) -> int | None:
        """Process id; None while there is no process."""
        child = self._child
        return None if child is None else child.pid

    @property
    def is_ready(self) -> bool:
        """Whether the worker runs and has compiled its code."""
        return self._is_ready and self.pid is not None

    def notify(self) -> None:
        """Notify the worker of new packets or requests; one that is gone is followed by one that looks for itself."""
        with self._lock:
            if self._child is not None:
                self._child.send()

    def stop(self) -> None:
        """Stop the worker after its current step, and wait; a worker that still compiles stops at once."""
        with self._lock:
            self._stopping.set()
            if self._child is not None:
                self._child.stop()
        self._thread.join()

    def _run(self) -> None:
        pause_s = 1.0
        while not self._stopping.is_set():
            began = time.monotonic()
            try:
                ended = f"ended with code {self._watch_one()}"
            except Exception as error:  # no program, no memory for it: that may pass
                ended = f"could not be run ({type(error).__name__}: {error})"
            if self._stopping.is_set():
                return
            if time.monotonic() - began > LONGEST_PAUSE_S:
                pause_s = 1.0
            pause_s = min(pause_s, self._longest_pause_s)
            _log.error("the worker %s; another one starts in %.0f s", ended, pause_s)
            self._stopping.wait(pause_s)
            pause_s *= 2.0

    def _watch_one(self) -> int:
        child = self._start()
        with self._lock:
            self._child, self._is_ready = child, False
            self.starts, self.applied = self.starts + 1, 0
            if self._stopping.is_set():
                child.stop()
        try:
            for event, content in child.events():
                self._note(event, content)
            return child.wait()
        finally:
            with self._lock:
                self._child = None

    def _note(self, event: str, content: Any) -> None:
        if event == READY:
            self._is_ready = True
        elif event == PROGRESS:
            self.applied = content
        else:
            self._listen(event, content)


class Elsewhere(NamedTuple):
    """The worker of a mission on another instance, as this one sees it."""

    is_ready: bool
    applied: int
    pid: int | None = None
    starts: int = 0

    def notify(self) -> None:
        """It looks for itself."""

    def stop(self) -> None:
        """It is stopped where it runs."""


RunningWorker = Supervisor | Elsewhere
"""A worker, wherever it runs."""


class StandbyWorkers:
    """Workers that have compiled their code before there is a mission for them. Any thread may call."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._is_closed = False
        self._waiting = [_new_worker() for _ in range(STANDBY_WORKERS)]

    def start(self, task: WorkerTask) -> Child:
        """Let a worker begin its task; another one stands by in its place."""
        with self._lock:
            alive = [worker for worker in self._waiting if worker.pid is not None]
            worker, self._waiting = (alive[0], alive[1:]) if alive else (_new_worker(), [])
            while len(self._waiting) < STANDBY_WORKERS and not self._is_closed:
                self._waiting.append(_new_worker())
        worker.send(json.dumps(task._asdict()))
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
