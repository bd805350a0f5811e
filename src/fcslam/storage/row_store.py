"""A store of rows, whose tables are in a SQLite file or on a PostgreSQL server.

Statements are written for both; marks are ``?``.
"""

import threading
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future
from contextlib import AbstractContextManager
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
        """Insert rows, whose REAL values are floats; ``replaces``: in place of those with the same key."""

    def stream(self, table: StoreTable) -> Iterator[tuple[Any, ...]]:
        """The rows of a table by its key, a few at a time."""


def all_rows(table: StoreTable) -> str:
    """The query of all rows of a table, by its key."""
    return f"SELECT {', '.join(table.columns)} FROM {table.name} ORDER BY {', '.join(table.key)}"


def change_rows(
    transaction: Transaction, table: StoreTable, changes: Mapping[str, object], where: str, values: Sequence[object]
) -> None:
    """Change columns of the rows for which ``where`` holds."""
    columns = ", ".join(table.columns)
    for row in transaction.execute(f"SELECT {columns} FROM {table.name} WHERE {where}", values).fetchall():
        changed = {**dict(zip(table.columns, row, strict=True)), **changes}
        transaction.insert(table, [tuple(changed.values())], replaces=True)


class RowStore(ABC):
    """Tables that several processes and threads may use; writers wait for each other.

    Raises:
        StoreError: from every method: the store cannot be used now, and nothing has changed.
    """

    def __init__(self) -> None:
        self._sharing = threading.Lock()
        self._waiting: deque[tuple[Callable[[Transaction], Any], Future[Any]]] = deque()

    @abstractmethod
    def transaction(self) -> AbstractContextManager[Transaction]:
        """Execute the block as one durable transaction."""

    @abstractmethod
    def rows(self, statement: str, values: Sequence[object] = ()) -> list[tuple[Any, ...]]:
        """All rows that a query finds."""

    @abstractmethod
    def export(self, path: Path) -> None:
        """Write all rows as one new SQLite file, atomically; there must be none yet."""

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
        done: Future[Result] = Future()
        self._waiting.append((work, done))
        with self._sharing:
            if not done.done():
                self._write_waiting()
        return done.result()

    def _write_waiting(self) -> None:
        together: list[tuple[Callable[[Transaction], Any], Future[Any]]] = []
        try:
            with self.transaction() as transaction:
                together = self._taken()  # only now: with those who came while this waited for another writer
                results = [work(transaction) for work, _ in together]
        except BaseException as error:  # it must reach all threads that share the transaction
            for _, done in together or self._taken():
                done.set_exception(error)
        else:
            for (_, done), result in zip(together, results, strict=True):
                done.set_result(result)

    def _taken(self) -> list[tuple[Callable[[Transaction], Any], Future[Any]]]:
        return [self._waiting.popleft() for _ in range(len(self._waiting))]
