"""One commit for all threads that wait for one, because each commit takes as long as the disk does."""

import threading
from collections import deque
from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

Transaction = TypeVar("Transaction")
Result = TypeVar("Result")


@dataclass(slots=True, eq=False)
class _Waiting:
    """Work that waits for a transaction."""

    work: Callable[[Any], Any]
    result: Any = None
    failure: BaseException | None = None
    is_done: bool = False


class GroupCommit(Generic[Transaction]):
    """Runs the work of several threads in one transaction."""

    def __init__(self, transaction: Callable[[], AbstractContextManager[Transaction]]) -> None:
        self._transaction = transaction
        self._lock = threading.Lock()
        self._waiting: deque[_Waiting] = deque()

    def share(self, work: Callable[[Transaction], Result]) -> Result:
        """Run ``work`` in a transaction that is shared by all threads that wait for one, so that one commit serves
        them all. If one work fails, none of them takes effect.
        """
        mine = _Waiting(work)
        self._waiting.append(mine)
        with self._lock:
            if not mine.is_done:
                self._write_waiting()
        if mine.failure is not None:
            raise mine.failure
        result: Result = mine.result
        return result

    def _write_waiting(self) -> None:
        together: list[_Waiting] = []
        try:
            with self._transaction() as transaction:
                together = self._taken()  # only now: with those who came while this waited for another writer
                for one in together:
                    one.result = one.work(transaction)
        except BaseException as error:  # an error in this thread must reach the threads that share its transaction
            together = together or self._taken()
            for one in together:
                one.failure = error
        finally:
            for one in together:
                one.is_done = True

    def _taken(self) -> list[_Waiting]:
        return [self._waiting.popleft() for _ in range(len(self._waiting))]
