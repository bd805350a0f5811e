"""SQLite databases: one file, durable transactions, schema versions, one kind of error."""

import os
import sqlite3
import threading
from collections.abc import Iterable, Iterator, Sequence
from contextlib import closing, contextmanager
from hashlib import blake2b
from pathlib import Path
from typing import Any

from fcslam.config import one_line
from fcslam.errors import StoreError
from fcslam.storage.row_store import RowStore, StoreTable, all_rows
from fcslam.untrusted import LimitError, open_database

_BUSY_S = 30.0
"""How long a writer waits for another process to finish."""


class SealedConnection(sqlite3.Connection):
    """A connection to a database whose rows end with a ``seal``."""

    def insert(self, table: StoreTable, rows: Iterable[Sequence[object]], *, replaces: bool = False) -> None:
        """As in ``Transaction``. The seal is of the values as they are read again."""
        marks = ", ".join("?" * len(table.columns))  # Python 3.12.1 takes ?1 for a name
        verb = "INSERT OR REPLACE" if replaces else "INSERT"
        sealed = f"{verb} INTO {table.name} VALUES ({marks}, seal('{table.name}', {marks}))"
        self.executemany(sealed, ((*row, *row) for row in rows))

    def stream(self, table: StoreTable) -> Iterator[tuple[Any, ...]]:
        """As in ``Transaction``."""
        return self.execute(all_rows(table))


class Database(RowStore):
    """A file that several processes and threads may use. Readers never wait."""

    def __init__(
        self, path: Path, schema: str, version: int, *, exclusive: bool = False, is_checked: bool = False
    ) -> None:
        """Open the file, or create it by the statements of ``schema``.

        ``exclusive``: no other process may open the file; no transaction waits for the disk, and a loss of power may
        take the last ones. ``is_checked``: ``check_file`` passed the file just now.
        """
        super().__init__()
        self._path = path
        self._lock, self._reading_lock = threading.Lock(), threading.Lock()
        # FULL: acknowledged packets must survive a loss of power.
        pragmas = ("locking_mode=EXCLUSIVE", "synchronous=NORMAL") if exclusive else ("synchronous=FULL",)
        with translate_errors(path):
            timeout_s = 0.0 if exclusive else _BUSY_S
            self._connection = self._reading = _connected(path, *pragmas, "journal_mode=WAL", timeout_s=timeout_s)
        try:
            if exclusive:
                self._reading_lock = self._lock
            else:
                # A commit takes as long as the disk does. A second connection lets readers see the state before it.
                with translate_errors(path):
                    self._reading = _connected(path, "query_only=ON")
            with self.transaction() as connection:
                if not _shape(connection)[1]:
                    _check_content(connection)  # its tables may be lost
                    _make(connection, schema, version)
            if not is_checked:
                with translate_errors(path):
                    _check(path, self._reading, schema, version)
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """As in ``RowStore``."""
        with self._lock:
            self._connection.close()
        with self._reading_lock:
            self._reading.close()

    @contextmanager
    def transaction(self) -> Iterator[SealedConnection]:
        """As in ``RowStore``."""
        with self._lock, translate_errors(self._path):
            self._connection.execute("BEGIN IMMEDIATE")
            try:
                yield self._connection
                self._connection.execute("COMMIT")
            finally:
                if self._connection.in_transaction:
                    self._connection.execute("ROLLBACK")

    def rows(self, statement: str, values: Sequence[object] = ()) -> list[tuple[Any, ...]]:
        """As in ``RowStore``."""
        with self._reading_lock, translate_errors(self._path):
            return self._reading.execute(statement, values).fetchall()

    def export(self, path: Path) -> None:
        """As in ``RowStore``."""
        staging = path.with_name(f".{path.name}.partial")
        # A separate connection: in write-ahead mode a long read blocks no writer.
        with (
            translate_errors(path),
            closing(sqlite3.connect(self._path, timeout=_BUSY_S, isolation_level=None)) as connection,
        ):
            connection.execute("PRAGMA trusted_schema=OFF")
            staging.unlink(missing_ok=True)
            try:
                connection.execute("VACUUM INTO ?", (str(staging),))
                with closing(sqlite3.connect(staging)) as written, translate_errors(self._path):
                    _check_content(written)
                os.link(staging, path)
            finally:
                staging.unlink(missing_ok=True)


def check_file(path: Path, schema: str, version: int) -> None:
    """Refuse a file of unknown origin that ``Database`` did not create; it is not changed and none of its code runs."""
    with translate_errors(path), closing(open_database(path)) as found:
        _check(path, found, schema, version)


def seal(*values: Any) -> bytes:
    """Checksum of a row: a BLAKE2b hash of the table's name and the row's values."""
    sizes, blobs = list(values), []
    for k, value in enumerate(values):
        kind = type(value)
        if kind is bytes:
            sizes[k] = len(value)
            blobs.append(value)
        elif kind is float:
            sizes[k] = value + 0.0  # SQLite stores -0.0 as 0.0
    checksum = blake2b(repr(sizes).encode(), digest_size=16)
    for blob in blobs:  # joined, they would be copied
        checksum.update(blob)
    return checksum.digest()


def _connected(path: Path, *pragmas: str, timeout_s: float = _BUSY_S) -> SealedConnection:
    # This module begins transactions explicitly.
    connection = sqlite3.connect(
        path, timeout=timeout_s, isolation_level=None, check_same_thread=False, factory=SealedConnection
    )
    try:
        for pragma in ("trusted_schema=OFF", *pragmas):
            connection.execute(f"PRAGMA {pragma}")
    except sqlite3.Error:
        connection.close()
        raise
    connection.create_function("seal", -1, seal, deterministic=True)
    return connection


def _check(path: Path, connection: sqlite3.Connection, schema: str, version: int) -> None:
    with closing(sqlite3.connect(":memory:")) as new:
        _make(new, schema, version)
        expected = _shape(new)
    found = _shape(connection)
    if found[0] not in (0, version):
        raise StoreError(f"{path}: a file of version {found[0]}; this fcslam reads version {version}")
    if found != expected:
        raise StoreError(f"{path}: not a file of this kind, or its schema is damaged; put its backup in its place")
    _check_content(connection)


def _check_content(connection: sqlite3.Connection) -> None:
    (found,) = connection.execute("PRAGMA integrity_check(1)").fetchone()
    if found != "ok":
        raise sqlite3.DatabaseError(found)
    for (table,) in connection.execute("SELECT name FROM sqlite_schema WHERE type = 'table'").fetchall():
        rows = connection.execute(f"SELECT * FROM {table}")
        if rows.description[-1][0] == "seal":
            wrong = sum(row[-1] != seal(table, *row[:-1]) for row in rows)
            if wrong:
                raise sqlite3.DatabaseError(f"{wrong} rows of {table} have a wrong checksum")


def _make(connection: sqlite3.Connection, schema: str, version: int) -> None:
    for statement in schema.split(";"):
        connection.execute(statement)
    connection.execute(f"PRAGMA user_version={version}")


def _shape(connection: sqlite3.Connection) -> tuple[int, list[tuple[Any, ...]]]:
    parts = connection.execute("SELECT type, name, tbl_name, sql FROM sqlite_schema ORDER BY type, name").fetchall()
    return connection.execute("PRAGMA user_version").fetchone()[0], parts


@contextmanager
def translate_errors(path: Path) -> Iterator[None]:
    """Raise errors of the disk and of SQLite as a ``StoreError`` of one line."""
    try:
        yield
    except LimitError as error:
        raise StoreError(f"{path}: {error}") from error
    except (OSError, sqlite3.DatabaseError, UnicodeDecodeError) as error:
        told = one_line(str(error))
        # without a code, ``_check_content`` found the damage, or a text cannot be decoded
        code = getattr(error, "sqlite_errorcode", sqlite3.SQLITE_CORRUPT) & 0xFF
        is_of_program = isinstance(error, OSError | sqlite3.ProgrammingError)
        if not is_of_program and code in (sqlite3.SQLITE_CORRUPT, sqlite3.SQLITE_NOTADB):
            raise StoreError(f"{path}: damaged or cut off ({told}); put its backup in its place") from error
        raise StoreError(f"{path}: cannot be read or written ({told}); is the disk full?") from error
