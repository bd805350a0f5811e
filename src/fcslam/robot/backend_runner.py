"""Where a robot's back end runs: in the process of the front end, or in another one beside it.

A live robot must not wait for the back end: the pose of a scan is due before the next scan comes, and a solve of a
large graph takes longer than that. A recording may wait, and does so on one core. Both get the same records in the same
order.
"""

import os
import signal
from collections.abc import Iterator
from concurrent.futures import Executor, Future, ProcessPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Protocol

from fcslam.errors import FeatureError
from fcslam.processes import obey_parent, worker_pool
from fcslam.robot.backend import BackendInput, RobotBackend, SessionConfig
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
        """Start the back end; ``keyframes`` as in ``RobotBackend``.

        Raises:
            StateError: the folder of keyframes cannot be written.
            FeatureError: the detector is a network whose weights cannot be used.
        """
        self._robot = robot
        self._executor = executor
        executor.submit(_begin, robot, config, keyframes).result()

    def submit(self, input: BackendInput) -> "Future[list[Body]]":
        """Queue the next input."""
        return self._executor.submit(_process, self._robot, input)


def worker_process() -> ProcessPoolExecutor:
    """An executor with one worker, another process with a lower priority than this one.

    Raises:
        InputError: the host gives processes no semaphores.
    """
    return worker_pool(_start_worker)


@contextmanager
def copied_worker() -> Iterator[ProcessPoolExecutor]:
    """A ``worker_process`` that shares the memory of the code loaded so far, until the end of this block.

    It is a copy of this process, made at once: begin this block before threads start, such as those of ROS. Objects
    that ``gc.freeze`` has frozen before stay shared.

    Raises:
        InputError: the host gives processes no semaphores.
    """
    executor = worker_pool(_start_worker, is_copy=True)
    try:
        executor.submit(os.getpid).result()
        yield executor
    finally:
        executor.shutdown(cancel_futures=True)


@contextmanager
def backend_process(robot: str, config: SessionConfig) -> Iterator[WorkerBackend]:
    """A back end in a process of its own, which ends with this block."""
    with copied_worker() as executor:
        yield WorkerBackend(robot, config, executor)


_backends: dict[str, RobotBackend] = {}
"""The back ends that run in this worker, by robot."""


def _begin(robot: str, config: SessionConfig, keyframes: Path | None) -> None:
    _backends[robot] = RobotBackend(robot, config, keyframes)


def _process(robot: str, input: BackendInput) -> list[Body]:
    return _backends[robot].process(input)


def _start_worker() -> None:
    obey_parent()
    signal.signal(signal.SIGTERM, signal.SIG_IGN)  # service managers stop both; the robot ends this one
    os.nice(YIELD_TO_TRACKER)
