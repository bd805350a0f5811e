"""Processes that end with the process that started them, however that ends: workers, and tasks beside it."""

import ctypes
import errno
import multiprocessing
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from multiprocessing.process import BaseProcess
from typing import Any, Final, Protocol

from fcslam.errors import InputError

NICENESS = 10
"""Increment of the niceness of a task in a copy of this process: what the process itself does goes first."""

_NO_SEMAPHORES = frozenset({errno.ENOENT, errno.EACCES, errno.EPERM, errno.EROFS, errno.ENOSPC, errno.ENOSYS})
"""Errors of a host that has none, and not of a process with too many open files, for example."""

_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD, _M_ARENA_MAX = -1, -3, -8
_ALLOCATOR: Final = {_M_TRIM_THRESHOLD: 1 << 17, _M_MMAP_THRESHOLD: 1 << 17, _M_ARENA_MAX: 2}
"""Options of glibc's ``mallopt``: the default sizes in bytes, which then do not adapt, and the number of heaps."""


class Background(Protocol):
    """A task that runs beside this process."""

    @property
    def exitcode(self) -> int | None:
        """None while it runs, 0 if it succeeded."""

    def terminate(self) -> None:
        """End it now, if it still runs."""

    def join(self) -> None:
        """Wait for its end."""


Start = Callable[[Callable[[], None]], Background]
"""Starts a task beside this process."""


class RecurringTask:
    """A task that runs beside this process again and again, for at most a share of the time."""

    def __init__(self, start: Start, clock: Callable[[], float], share: float, every_s: float) -> None:
        """``every_s``: the shortest time between the end of one run and the beginning of the next."""
        self._start, self._clock, self._share, self._every_s = start, clock, share, every_s
        self._running: Background | None = None
        self._began_s = clock()
        self.due_s = self._began_s
        """When the next run may begin, by the clock."""

    @property
    def is_running(self) -> bool:
        """Whether a run has begun and ``end`` has not said that it ended."""
        return self._running is not None

    @property
    def is_due(self) -> bool:
        """Whether a run may begin now."""
        return self._running is None and self._clock() >= self.due_s

    def begin(self, task: Callable[[], None]) -> None:
        """Begin a run."""
        self._began_s = self._clock()
        self._running = self._start(task)

    def end(self) -> int | None:
        """The exit code of a run that has ended since the last call; None: none has."""
        if self._running is None or self._running.exitcode is None:
            return None
        exitcode, self._running = self._running.exitcode, None
        now = self._clock()
        self.due_s = now + max((now - self._began_s) * (1.0 / self._share - 1.0), self._every_s)
        return exitcode

    def stop(self) -> None:
        """End a run that goes on."""
        if self._running is not None:
            self._running.terminate()
            self._running.join()
            self._running = None


def keep_memory_trimmed() -> None:
    """Let this process give freed memory back to the system at once, also between memory in use.

    glibc by default keeps a heap for each of many threads, and puts ever longer arrays into them. So a process that
    runs for days grows by the gaps, although what it uses does not. Other allocators stay as they are. Where long
    arrays come and go all the time, this costs much CPU: call ``trim_memory`` now and then there.
    """
    for option, value in _ALLOCATOR.items():
        _glibc("mallopt", option, value)


def trim_memory() -> None:
    """Give memory that is free now back to the system."""
    _glibc("malloc_trim", 0)


def _glibc(name: str, *values: int) -> None:
    """Call a function that other C libraries lack."""
    function = getattr(ctypes.CDLL(None), name, None)
    if function is not None:
        function(*values)


def start_method() -> Any:
    """The context of quick workers: copies of this process, which has loaded all code, where such copies are safe."""
    return multiprocessing.get_context("fork" if sys.platform == "linux" else "spawn")


def worker_pool(start: Callable[[], None], is_copy: bool = False) -> ProcessPoolExecutor:
    """An executor with one worker, another process that calls ``start`` first.

    Args:
        start: called in the worker.
        is_copy: the worker is a copy of this process when it begins its first task, where copies are safe.

    Raises:
        InputError: the host gives processes no semaphores.
    """
    with needing_semaphores():
        return ProcessPoolExecutor(1, start_method() if is_copy else multiprocessing.get_context("spawn"), start)


@contextmanager
def needing_semaphores() -> Iterator[None]:
    """Create queues and semaphores of processes in this block.

    Raises:
        InputError: the host has none, such as a container without a writable /dev/shm.
    """
    try:
        yield
    except OSError as error:
        if error.errno not in _NO_SEMAPHORES:
            raise
        raise InputError(
            f"/dev/shm: more than one process needs semaphores, which cannot be made there ({error}); "
            "mount it writable, with free space"
        ) from error


def obey_parent() -> None:
    """Make this process a worker: Ctrl-C, which reaches all processes, is its parent's, and it ends with its parent."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def start_copy(task: Callable[[], None]) -> Background:
    """Run a task in a copy of this process. It sees everything as it is now, and nothing that it changes is seen here.

    Threads do not exist in the copy; OpenCV must have one thread (``cv2.setNumThreads``), or the copy waits for others.
    """
    process: BaseProcess = multiprocessing.get_context("fork").Process(target=_in_copy, args=(task,), daemon=True)
    process.start()
    return process


def _in_copy(task: Callable[[], None]) -> None:
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    obey_parent()
    os.nice(NICENESS)
    task()


def _end_with_parent() -> None:
    """A parent that is killed cannot end its workers."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)
