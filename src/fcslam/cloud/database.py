"""SQLite as this project uses it: one file, durable transactions, one kind of error."""

import os
import sqlite3
import threading
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

from fcslam.errors import StoreError

BUSY_S = 30.0
"""How long a writer waits for another process to finish."""


class Database:
    """A file that several processes and threads may use; within a process one call waits for the other.

    Raises:
        StoreError: from every method: the disk is full or broken, and nothing has changed.
    """

    def __init__(self, path: Path, schema: str, version: int) -> None:
        """Open the file; one that is not there yet is made by ``schema``.

        Raises:
            StoreError: it was made by something else, or cannot be used.
        """
        self._path = path
        self._lock = threading.Lock()
        with told(path):
            # Transactions begin where this module says so.
            self._connection = sqlite3.connect(path, timeout=BUSY_S, isolation_level=None, check_same_thread=False)
            # What is acknowledged must outlast a loss of power: FULL.
            for pragma in ("trusted_schema=OFF", "journal_mode=WAL", "synchronous=FULL"):
                self._connection.execute(f"PRAGMA {pragma}")
        with self.transaction() as connection:
            if not _shape(connection)[1]:
                _make(connection, schema, version)
            if _shape(connection) != _expected(schema, version):
                raise StoreError(f"{path}: no file of this kind, or of another version of fcslam")

    def close(self) -> None:
        """Let go of the file."""
        with self._lock:
            self._connection.close()

    @contextmanager
    def transaction(self) -> Iterator[sqlite3.Connection]:
        """What is executed in the block happens as a whole and is on disk afterwards, or does not happen at all."""
        with self._lock, told(self._path):
            self._connection.execute("BEGIN IMMEDIATE")
            try:
                yield self._connection
                self._connection.execute("COMMIT")
            finally:
                if self._connection.in_transaction:
                    self._connection.execute("ROLLBACK")

    def rows(self, statement: str, values: Sequence[object] = ()) -> list[tuple[Any, ...]]:
        """All rows that a query finds."""
        with self._lock, told(self._path):
            return self._connection.execute(statement, values).fetchall()

    def value(self, statement: str, values: Sequence[object] = ()) -> Any:
        """First column of the first row that a query finds; None if it finds none."""
        rows = self.rows(statement, values)
        return rows[0][0] if rows else None

    def export(self, path: Path) -> None:
        """Write all as one new file, as it was at one moment; it is whole or not there.

        Raises:
            StoreError: there is a file already, or it cannot be written.
        """
        staging = path.with_name(f".{path.name}.partial")
        # A connection of its own: it takes long, and in write-ahead mode keeps nobody waiting.
        with told(path), closing(sqlite3.connect(self._path, timeout=BUSY_S, isolation_level=None)) as connection:
            connection.execute("PRAGMA trusted_schema=OFF")
            staging.unlink(missing_ok=True)
            try:
                connection.execute("VACUUM INTO ?", (str(staging),))
                os.link(staging, path)
            finally:
                staging.unlink(missing_ok=True)


def check_file(path: Path, schema: str, version: int) -> None:
    """Refuse a file from elsewhere that ``Database`` did not make; it is not changed, and nothing in it is run.

    Raises:
        StoreError: it is broken, or has other tables than those of ``schema``, or anything else.
    """
    with told(path), closing(sqlite3.connect(f"{path.resolve().as_uri()}?mode=ro&immutable=1", uri=True)) as found:
        found.execute("PRAGMA trusted_schema=OFF")
        if _shape(found) != _expected(schema, version):
            raise StoreError(f"{path}: no file of this kind, or of another version of fcslam")
        if found.execute("PRAGMA integrity_check(1)").fetchone()[0] != "ok":
            raise StoreError(f"{path}: broken")


def _make(connection: sqlite3.Connection, schema: str, version: int) -> None:
    for statement in schema.split(";"):
        connection.execute(statement)
    connection.execute(f"PRAGMA user_version={version}")


def _shape(connection: sqlite3.Connection) -> tuple[int, list[tuple[Any, ...]]]:
    """Version, and everything that is not data."""
    parts = connection.execute("SELECT type, name, tbl_name, sql FROM sqlite_schema ORDER BY type, name").fetchall()
    return connection.execute("PRAGMA user_version").fetchone()[0], parts


def _expected(schema: str, version: int) -> tuple[int, list[tuple[Any, ...]]]:
    with closing(sqlite3.connect(":memory:")) as connection:
        _make(connection, schema, version)
        return _shape(connection)


@contextmanager
def told(path: Path) -> Iterator[None]:
    """Turn what disks and SQLite have to say into one line."""
    try:
        yield
    except (OSError, sqlite3.DatabaseError) as error:
        raise StoreError(f"{path}: cannot be read or written ({error}); is the disk full?") from error
