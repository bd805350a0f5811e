"""Child processes, all of which end with the process that started them, however that ends.

A ``Child`` is a module of fcslam that runs as a program and reports events; ``run_module`` waits for one; a
``worker_pool`` calls functions; ``start_copy`` runs a task in a copy of this process, and a ``Stream`` also gets what
the task sends. Only this module starts processes.
"""

import ctypes
import errno
import json
import logging
import multiprocessing
import os
import pickle
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor, ProcessPoolExecutor, ThreadPoolExecutor
from contextlib import contextmanager, suppress
from multiprocessing.connection import Connection
from multiprocessing.pool import ExceptionWithTraceback  # type: ignore[attr-defined]
from multiprocessing.process import BaseProcess
from typing import Any, Generic, TypeVar

from fcslam.errors import FcslamError, InputError

NICENESS = 10
"""Increment of the niceness of a task in a copy of this process: what the process itself does goes first."""

Task = Callable[[], None]
Background = BaseProcess
"""A task that runs beside this process."""
Start = Callable[[Task, int], Background]
"""Starts a task beside this process with a niceness, as ``start_copy`` does."""

_log = logging.getLogger(__name__)
Item = TypeVar("Item")


def module_command(module: str, *arguments: str) -> list[str]:
    """The command that runs a module of fcslam."""
    return [sys.executable, "-m", module, *arguments]


class Child:
    """A program beside this one. Its stdin ends with this process; on stdout it writes events (``emit_event``)."""

    def __init__(self, command: Sequence[str]) -> None:
        # Unbuffered: what a dead child did not read must not turn up when the pipe is closed.
        self._process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, bufsize=0)
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._stdin, self._stdout = self._process.stdin, self._process.stdout
        os.set_blocking(self._stdin.fileno(), False)

    @property
    def pid(self) -> int | None:
        """None after its end."""
        return self._process.pid if self._process.poll() is None else None

    def send(self, line: str = "") -> None:
        """Write a line to its stdin, unless it has ended or does not read."""
        with suppress(OSError, ValueError):
            self._stdin.write(f"{line}\n".encode())

    def events(self) -> Iterator[tuple[str, Any]]:
        """Its events with their contents, until it ends."""
        with self._stdout as lines:
            for line in lines:
                try:
                    message = json.loads(line)
                    event = str(message["event"]), message["content"]
                except (ValueError, TypeError, KeyError):
                    _log.error("unreadable event of a process: %.200r", line)
                else:
                    yield event

    def wait(self) -> int:
        """End its stdin and wait for its end; returns its exit code."""
        with suppress(OSError):
            self._stdin.close()
        return self._process.wait()

    def stop(self, patience_s: float | None = None) -> None:
        """End its stdin and send SIGTERM, which it may ignore until its current step is done.

        ``patience_s``: wait for its end, and kill it if it takes longer.
        """
        with suppress(OSError):
            self._stdin.close()
        self._process.terminate()
        if patience_s is not None:
            with suppress(subprocess.TimeoutExpired):
                self._process.wait(patience_s)
            self._process.kill()
            self.wait()


def emit_event(event: str, content: Any) -> None:
    """Report an event to the process that started this ``Child``."""
    sys.stdout.write(json.dumps({"event": event, "content": content}) + "\n")
    sys.stdout.flush()


def run_module(module: str, *arguments: str, timeout_s: float) -> tuple[int, str]:
    """Run a module to its end, or kill it (``TimeoutError``); returns its exit code and what it wrote to stdout."""
    command = module_command(module, *arguments)
    try:
        ended = subprocess.run(command, capture_output=True, text=True, timeout=timeout_s, check=False)
    except subprocess.TimeoutExpired as error:
        raise TimeoutError(f"{module} did not end within {timeout_s:.0f} s") from error
    return ended.returncode, ended.stdout


def worker_pool(niceness: int = 0, is_copy: bool = False) -> Executor:
    """An executor with one worker, another process, which ignores SIGTERM: service managers send it to both.

    ``is_copy``: the worker is a copy of this process when it begins its first task, where copies are safe. A host that
    gives processes no semaphores is an ``InputError``.
    """
    context = _copying() if is_copy else multiprocessing.get_context("spawn")
    with _needing_semaphores():
        return ProcessPoolExecutor(1, context, _begin_worker, (niceness,))


def semaphore(count: int) -> Any:
    """A semaphore that this process shares with its copies; raises as ``worker_pool``."""
    with _needing_semaphores():
        return _copying().BoundedSemaphore(count)


def start_copy(task: Task, niceness: int) -> Background:
    """Run a task in a copy of this process. It sees everything as it is now, and nothing that it changes is seen here.

    Threads do not exist in the copy; OpenCV must have one thread (``cv2.setNumThreads``), or the copy waits for others.
    """
    process = multiprocessing.get_context("fork").Process(target=_run_copy, args=(task, niceness), daemon=True)
    process.start()
    return process


class Stream(Generic[Item]):
    """The items that a task in a copy of this process sends. What is not read yet waits in the copy."""

    def __init__(self, name: str, task: Callable[[Callable[[Item], None]], None]) -> None:
        """Start ``task``, which is called with what sends an item; ``name`` is that of its process in errors."""
        self._name, context = name, _copying()
        self._receiving, sending = context.Pipe(duplex=False)
        self._process: BaseProcess = context.Process(target=_run_stream, args=(task, sending), daemon=True)
        self._process.start()
        sending.close()

    def __iter__(self) -> Iterator[Item]:
        """The items; an error of the task is raised here, or a ``FcslamError`` if its process ended too early."""
        while True:
            try:
                item, error = pickle.loads(self._receiving.recv_bytes())
            except (EOFError, OSError):
                break
            if error is not None:
                raise error
            yield item
        self._process.join()
        if self._process.exitcode:
            raise FcslamError(
                f"{self._name}: its process ended with code {self._process.exitcode}; if memory ran out, use fewer "
                "cores (taskset) or map fewer robots together"
            )

    def stop(self) -> None:
        """End the process."""
        self._process.terminate()
        self._process.join()
        self._receiving.close()


def keep_memory_trimmed() -> None:
    """Let this process give freed memory back to the system at once, also between memory in use.

    By default, the gaps of glibc's heaps grow in a process that runs for days. Where long arrays come and go all the
    time, this costs much CPU: call ``trim_memory`` now and then there.
    """
    for option, value in ((-1, 1 << 17), (-3, 1 << 17), (-8, 2)):  # M_TRIM_THRESHOLD, M_MMAP_THRESHOLD, M_ARENA_MAX
        _glibc("mallopt", option, value)


def trim_memory() -> None:
    """Give memory that is free now back to the system."""
    _glibc("malloc_trim", 0)


def _glibc(name: str, *values: int) -> None:
    """Call a function that other C libraries lack."""
    function = getattr(ctypes.CDLL(None), name, None)
    if function is not None:
        function(*values)


def _copying() -> Any:
    """The context of copies of this process, which has loaded all code, where such copies are safe."""
    return multiprocessing.get_context("fork" if sys.platform == "linux" else "spawn")


@contextmanager
def _needing_semaphores() -> Iterator[None]:
    try:
        yield
    except OSError as error:
        if error.errno in (errno.EMFILE, errno.ENFILE, errno.ENOMEM):
            raise
        raise InputError(
            f"/dev/shm: more than one process needs semaphores, which cannot be made there ({error}); "
            "mount it writable, with free space"
        ) from error


def _begin_worker(niceness: int) -> None:
    _exit_with_parent()
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    os.nice(niceness)


def _run_copy(task: Callable[[], None], niceness: int) -> None:
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    _exit_with_parent()
    os.nice(niceness)
    task()


def _run_stream(task: Callable[[Callable[[Item], None]], None], sending: Connection) -> None:
    _exit_with_parent()
    with ThreadPoolExecutor(1) as sender:  # what the parent does not read yet waits for this thread

        def put(item: Item | None, error: object = None) -> None:
            # this protocol keeps arrays read-only
            sender.submit(sending.send_bytes, pickle.dumps((item, error), pickle.HIGHEST_PROTOCOL))

        try:
            task(put)
        except Exception as error:
            put(None, ExceptionWithTraceback(error, error.__traceback__))


def _exit_with_parent() -> None:
    """End with the parent, also if it is killed. Ctrl-C reaches all processes, and the parent handles it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_await_parent, daemon=True).start()


def _await_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)
