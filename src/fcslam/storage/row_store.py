"""A store of rows, whose tables are in a SQLite file or on a PostgreSQL server.

Statements are written for both: marks are ``?``, or ``:name`` with a mapping.
"""

import threading
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, Protocol, TypeVar

Result = TypeVar("Result")


class StoreTable(NamedTuple):
    """A table as statements name it."""

    name: str
    key: tuple[str, ...]
    """Columns whose values are unique together."""
    columns: tuple[str, ...]
    """All columns in their order, without a seal."""


class Transaction(Protocol):
    """A transaction that is open."""

    def execute(self, statement: str, values: Sequence[object] = (), /) -> Any:
        """Execute a statement; returns a cursor over the rows that it found."""

    def insert(self, table: StoreTable, rows: Iterable[Sequence[object]], *, replaces: bool = False) -> None:
        """Insert rows; ``replaces``: in place of those with the same key.

        Values of REAL columns must be floats.
        """

    def update(
        self, table: StoreTable, changes: Mapping[str, object], where: str, values: Mapping[str, object]
    ) -> None:
        """Change columns of the rows for which ``where`` holds; ``values`` are those of its names."""


@dataclass(slots=True, eq=False)
class _Waiting:
    """Work that waits for a transaction."""

    work: Callable[[Transaction], Any]
    result: Any = None
    failure: BaseException | None = None
    is_done: bool = False


class RowStore(ABC):
    """Tables that several processes and threads may use; writers wait for each other.

    Raises:
        StoreError: from every method: the store cannot be used now, and nothing has changed.
    """

    def __init__(self) -> None:
        self._sharing = threading.Lock()
        self._waiting: deque[_Waiting] = deque()

    @abstractmethod
    def transaction(self) -> AbstractContextManager[Transaction]:
        """Execute the block as one durable transaction."""

    @abstractmethod
    def rows(self, statement: str, values: Sequence[object] = ()) -> list[tuple[Any, ...]]:
        """All rows that a query finds."""

    @abstractmethod
    def export(self, path: Path) -> None:
        """Write all rows as one new SQLite file, atomically.

        Raises:
            StoreError: there is a file already, it cannot be written, or the store is damaged.
        """

    @abstractmethod
    def close(self) -> None:
        """Free what it holds."""

    def value(self, statement: str, values: Sequence[object] = ()) -> Any:
        """First column of the first row that a query finds; None if it finds none."""
        rows = self.rows(statement, values)
        return rows[0][0] if rows else None

    def share(self, work: Callable[[Transaction], Result]) -> Result:
        """Run ``work`` in a transaction that is shared by all threads that wait for one: each commit takes as long as
        the disk does. If one work fails, none of them takes effect.
        """
        mine = _Waiting(work)
        self._waiting.append(mine)
        with self._sharing:
            if not mine.is_done:
                self._write_waiting()
        if mine.failure is not None:
            raise mine.failure
        result: Result = mine.result
        return result

    def _write_waiting(self) -> None:
        together: list[_Waiting] = []
        try:
            with self.transaction() as transaction:
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
