"""Remembers what a worker was doing when it died, so that one task cannot end every worker after it."""

import json
import os
from contextlib import suppress
from pathlib import Path

MOST_CRASHES = 3
"""Consecutive workers that may die at one task; the next worker leaves the task out."""
_SIZE = 512
"""Bytes of the file, always written whole."""


class CrashLog:
    """A small file that outlives the worker, not a loss of power: a task costs no wait for the disk."""

    def __init__(self, path: Path) -> None:
        """Read what the worker before was at."""
        self._file = os.open(path, os.O_RDWR | os.O_CREAT, 0o666)
        self._suspect, self._crashes = "", 0
        """The task at which the worker before died, and how many workers in a row did."""
        self._at = ""
        """The present task; empty between two."""
        try:
            before = json.loads(os.pread(self._file, _SIZE, 0) or b"{}")
            at, suspect, crashes = str(before.get("at", "")), before.get("suspect"), int(before.get("crashes", 0))
        except (ValueError, TypeError, AttributeError):
            return
        if at:
            self._suspect, self._crashes = at, crashes + 1 if at == suspect else 1
        elif suspect:
            self._suspect, self._crashes = str(suspect), crashes

    def is_fatal(self, task: str) -> bool:
        """Whether the task is left out, after killing too many workers in a row."""
        return task == self._suspect and self._crashes >= MOST_CRASHES

    def begin(self, task: str) -> None:
        """Note that the worker begins a task, and has survived the one before."""
        if self._at and self._at == self._suspect:
            self._suspect, self._crashes = "", 0
        self._at = task
        state = {"at": self._at, "suspect": self._suspect, "crashes": self._crashes}
        with suppress(OSError):  # the disk is full
            os.pwrite(self._file, json.dumps(state).encode().ljust(_SIZE), 0)

    def end(self) -> None:
        """Note that the worker has survived its task."""
        self.begin("")
