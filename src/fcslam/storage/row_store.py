"""The interface of a store of rows, whose tables are in a SQLite file or on a PostgreSQL server.

Statements are written for both: marks are ``?``, or ``:name`` with a mapping.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
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


class Found(Protocol):
    """The rows that a statement found."""

    def __iter__(self) -> Iterator[Any]:
        """The rows that are left."""

    def fetchone(self) -> Any:
        """The next row; None after the last one."""

    def fetchall(self) -> list[Any]:
        """All rows that are left."""


class Transaction(Protocol):
    """A transaction that is open."""

    def execute(self, statement: str, values: Sequence[object] = (), /) -> Found:
        """Execute a statement."""

    def insert(self, table: StoreTable, rows: Iterable[Sequence[object]], *, replaces: bool = False) -> None:
        """Insert rows; ``replaces``: in place of those with the same key.

        Values of REAL columns must be floats.
        """

    def update(
        self, table: StoreTable, changes: Mapping[str, object], where: str, values: Mapping[str, object]
    ) -> None:
        """Change columns of the rows for which ``where`` holds; ``values`` are those of its names."""


class RowStore(Protocol):
    """Tables that several processes and threads may use; writers wait for each other.

    Raises:
        StoreError: from every method: the store cannot be used now, and nothing has changed.
    """

    def transaction(self) -> AbstractContextManager[Transaction]:
        """Execute the block as one durable transaction."""

    def share(self, work: Callable[[Transaction], Result]) -> Result:
        """Run ``work`` in a transaction that is shared by all threads that wait for one. If one work fails, none of
        them takes effect.
        """

    def rows(self, statement: str, values: Sequence[object] = ()) -> list[tuple[Any, ...]]:
        """All rows that a query finds."""

    def value(self, statement: str, values: Sequence[object] = ()) -> Any:
        """First column of the first row that a query finds; None if it finds none."""

    def export(self, path: Path) -> None:
        """Write all rows as one new SQLite file, atomically.

        Raises:
            StoreError: there is a file already, or it cannot be written.
        """

    def close(self) -> None:
        """Free what it holds."""
