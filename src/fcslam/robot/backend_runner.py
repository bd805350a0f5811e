"""Where a robot's back end runs: in the process of the front end, or in another one beside it.

A live robot must not wait for the back end: the pose of a scan is due before the next scan comes, and a solve of a
large graph takes longer than that. A recording may wait, and does so on one core. Both get the same records in the same
order.
"""

import os
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, Future
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any, Generic, TypeVar

from fcslam.errors import FeatureError
from fcslam.processes import worker_pool
from fcslam.robot.backend import BackendInput, RobotBackend, SessionConfig
from fcslam.wire.messages import Body

YIELD_TO_TRACKER = 5
"""Increment of the worker's niceness: where cores are few, the tracker goes first."""

Submit = Callable[[BackendInput], "Future[list[Body]]"]
"""Starts to handle the next input of a robot's back end; see ``RobotBackend.process``."""
Thing = TypeVar("Thing")
Answer = TypeVar("Answer")


def inline(backend: RobotBackend) -> Submit:
    """Run a back end at once; its errors are errors of the caller."""

    def submit(input: BackendInput) -> "Future[list[Body]]":
        done: Future[list[Body]] = Future()
        try:
            done.set_result(backend.process(input))
        except FeatureError as error:
            done.set_exception(error)
        return done

    return submit


def in_worker(robot: str, config: SessionConfig, executor: Executor, keyframes: Path | None = None) -> Submit:
    """Start a back end in the only worker of an executor; ``keyframes`` as in ``RobotBackend``."""
    backend = WorkerObject(executor, f"back end of {robot}", RobotBackend, robot, config, keyframes)
    return partial(backend.submit, RobotBackend.process)


class WorkerObject(Generic[Thing]):
    """An object in the only worker of an executor, perhaps another process: calls with it run one after the other."""

    def __init__(self, executor: Executor, name: str, make: Callable[..., Thing], *arguments: object) -> None:
        """Wait for ``make(*arguments)`` in the worker, and raise its error; the object replaces one of this name."""
        self._executor, self._name = executor, name
        executor.submit(_make, name, make, arguments).result()

    def submit(self, function: Callable[..., Answer], *arguments: object) -> Future[Answer]:
        """Queue ``function(object, *arguments)``; a RuntimeError if the worker has ended."""
        return self._executor.submit(_call, self._name, function, arguments)

    def call(self, function: Callable[..., Answer], *arguments: object) -> Future[Answer]:
        """As ``submit``; an error is one of the future."""
        try:
            return self.submit(function, *arguments)
        except RuntimeError as error:
            failed: Future[Answer] = Future()
            failed.set_exception(error)
            return failed


_objects: dict[str, Any] = {}
"""Objects in this worker, by name."""


def _make(name: str, make: Callable[..., object], arguments: tuple[object, ...]) -> None:
    _objects[name] = make(*arguments)


def _call(name: str, function: Callable[..., Answer], arguments: tuple[object, ...]) -> Answer:
    return function(_objects[name], *arguments)


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
def backend_process(robot: str, config: SessionConfig) -> Iterator[Submit]:
    """A back end in a process of its own, which ends with this block."""
    with copied_worker() as executor:
        yield in_worker(robot, config, executor)
