"""Where a robot's back end runs: in the process of the front end, or in another one beside it.

A live robot must not wait for the back end: the pose of a scan is due before the next scan comes, and a solve of a
large graph takes longer than that. A recording may wait, and does so on one core. Both get the same records in the same
order.
"""

import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import BrokenExecutor, Executor, Future, InvalidStateError
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, Protocol

from fcslam.errors import FeatureError
from fcslam.processes import worker_pool
from fcslam.robot.backend import BackendInput, RobotBackend, SessionConfig
from fcslam.robot.worker_object import WorkerObject
from fcslam.wire.messages import Body

YIELD_TO_TRACKER = 5
"""Increment of the worker's niceness: where cores are few, the tracker goes first."""


class BackendRunner(Protocol):
    """Handles the inputs of one robot's back end in their order."""

    def submit(self, input: BackendInput) -> "Future[list[Body]]":
        """Start to handle the next input; see ``RobotBackend.process``."""


class InlineBackend:
    """Runs the back end at once; its errors are errors of the caller."""

    def __init__(self, backend: RobotBackend) -> None:
        self._backend = backend

    def submit(self, input: BackendInput) -> "Future[list[Body]]":
        """Handle the next input; the result is ready."""
        done: Future[list[Body]] = Future()
        try:
            done.set_result(self._backend.process(input))
        except FeatureError as error:
            done.set_exception(error)
        return done


class WorkerBackend:
    """Runs the back end in the only worker of an executor, which may be another process."""

    def __init__(self, robot: str, config: SessionConfig, executor: Executor, keyframes: Path | None = None) -> None:
        """Start the back end; ``keyframes`` as in ``RobotBackend``."""
        self._backend = WorkerObject(executor, f"back end of {robot}", RobotBackend, robot, config, keyframes)

    def submit(self, input: BackendInput) -> "Future[list[Body]]":
        """Queue the next input."""
        return self._backend.submit(RobotBackend.process, input)


class BlockExecutor(Executor):
    """Passes tasks to another executor in blocks, as each transfer to another process wakes three threads.

    A task waits until its block is full or its result is asked for. An error is an error of all tasks of the block.
    """

    def __init__(self, executor: Executor, size: int) -> None:
        self._executor, self._size = executor, size
        self._block: list[tuple[_BlockTask, Callable[..., Any], tuple[Any, ...]]] = []
        self._unfinished: list[_BlockTask] = []

    def submit(self, function: Callable[..., Any], /, *arguments: Any) -> "Future[Any]":  # type: ignore[override]
        """Add a task to the block."""
        task = _BlockTask(self._start)
        self._block.append((task, function, arguments))
        if len(self._block) >= self._size:
            self._start()
        return task

    def _start(self) -> None:
        block, self._block = self._block, []
        if not block:
            return
        tasks = [task for task, _, _ in block]
        self._unfinished = [task for task in self._unfinished if not task.done()] + tasks
        try:
            results = self._executor.submit(_run_all, [(function, arguments) for _, function, arguments in block])
        except BrokenExecutor as error:
            for task in self._unfinished:  # also of a block that came while the executor broke: it may be lost (3.11)
                with suppress(InvalidStateError):
                    task.set_exception(error)
            return
        results.add_done_callback(lambda results: _hand_out(results, tasks))


class _BlockTask(Future[Any]):
    """The future of one task of a block."""

    def __init__(self, start: Callable[[], None]) -> None:
        super().__init__()
        self._start = start

    def result(self, timeout: float | None = None) -> Any:
        """The result; starts the block."""
        self._start()
        return super().result(timeout)


def _run_all(tasks: Sequence[tuple[Callable[..., Any], tuple[Any, ...]]]) -> list[Any]:
    return [function(*arguments) for function, arguments in tasks]


def _hand_out(results: "Future[list[Any]]", tasks: Sequence[_BlockTask]) -> None:
    error = results.exception()
    for number, task in enumerate(tasks):
        with suppress(InvalidStateError):
            if error is None:
                task.set_result(results.result()[number])
            else:
                task.set_exception(error)


def worker_process() -> Executor:
    """An executor with one worker, another process with a lower priority than this one."""
    return worker_pool(YIELD_TO_TRACKER)


@contextmanager
def copied_worker() -> Iterator[Executor]:
    """A ``worker_process`` that shares the memory of the code loaded so far, until the end of this block.

    It is a copy of this process, made at once: begin this block before threads start, such as those of ROS. Objects
    that ``gc.freeze`` has frozen before stay shared.
    """
    executor = worker_pool(YIELD_TO_TRACKER, is_copy=True)
    try:
        executor.submit(os.getpid).result()
        yield executor
    finally:
        executor.shutdown(cancel_futures=True)


@contextmanager
def backend_process(robot: str, config: SessionConfig, block: int = 1) -> Iterator[WorkerBackend]:
    """A back end in a process of its own, which ends with this block.

    Args:
        robot: its name.
        config: its settings.
        block: inputs that go there together; 1 for a live robot.
    """
    with copied_worker() as executor:
        yield WorkerBackend(robot, config, executor if block == 1 else BlockExecutor(executor, block))
