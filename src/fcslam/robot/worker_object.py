"""An object in the only worker of an executor, perhaps another process: its calls run there one after the other."""

from collections.abc import Callable
from concurrent.futures import Executor, Future
from typing import Any, Generic, TypeVar

Thing = TypeVar("Thing")
Answer = TypeVar("Answer")


class WorkerObject(Generic[Thing]):
    """Makes an object in the worker and calls functions with it."""

    def __init__(self, executor: Executor, name: str, make: Callable[..., Thing], *arguments: object) -> None:
        """Wait for ``make(*arguments)`` in the worker, and raise its error; the object replaces one of this name."""
        self._executor, self._name = executor, name
        executor.submit(_make, name, make, arguments).result()

    def submit(self, function: Callable[..., Answer], *arguments: object) -> Future[Answer]:
        """Queue ``function(object, *arguments)``.

        Raises:
            RuntimeError: the worker has ended, or the executor was shut down.
        """
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
