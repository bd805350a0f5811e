"""Missions on a PostgreSQL server: the tables, and the rows of one mission.

The schema ``fcslam`` holds what all missions share; each mission has a schema of its own with the tables of a mission
file, and what its worker leaves for other instances.
"""

import re
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager, suppress
from pathlib import Path
from typing import Any, Final, NamedTuple

from fcslam.errors import InputError, StoreError
from fcslam.mission.mission_store import SCHEMA, TABLES
from fcslam.mission.mission_store import VERSION as FILE_VERSION
from fcslam.storage.database import Database, translate_errors
from fcslam.storage.postgres import Postgres, PostgresTransaction
from fcslam.storage.row_store import RowStore, Transaction

VERSION: Final = 2
"""Version of the tables."""
LOCK: Final = 0x0FC51A  # of fcslam's, in case other programs lock as well
"""The lock of whoever makes the tables, and first number of the locks of those who write to a mission."""
SHARED: Final = """
CREATE TABLE missions (
    number BIGINT GENERATED ALWAYS AS IDENTITY PRIMARY KEY,
    name TEXT COLLATE "C" NOT NULL UNIQUE,
    is_open BOOLEAN NOT NULL DEFAULT false,
    is_wanted BOOLEAN NOT NULL DEFAULT false,
    holder TEXT, fence BIGINT NOT NULL DEFAULT 0, expires TIMESTAMPTZ NOT NULL DEFAULT '-infinity',
    is_ready BOOLEAN NOT NULL DEFAULT false, touched TIMESTAMPTZ NOT NULL DEFAULT clock_timestamp(),
    live BIGINT NOT NULL DEFAULT 0, finalized BIGINT NOT NULL DEFAULT 0
);
CREATE UNIQUE INDEX one_open ON missions (is_open) WHERE is_open;
CREATE TABLE instances (
    name TEXT COLLATE "C" PRIMARY KEY, process TEXT NOT NULL, room BIGINT NOT NULL, expires TIMESTAMPTZ NOT NULL
);
CREATE TABLE audit (
    number BIGINT GENERATED ALWAYS AS IDENTITY PRIMARY KEY, instance TEXT NOT NULL, entry TEXT NOT NULL
);
CREATE TABLE detectors (
    number BIGINT GENERATED ALWAYS AS IDENTITY PRIMARY KEY,
    channel TEXT NOT NULL, version TEXT NOT NULL, content BYTEA NOT NULL, UNIQUE (channel, version)
)
"""
_TYPES: Final = {
    "INTEGER": "BIGINT",
    "REAL": "DOUBLE PRECISION",
    "BLOB": "BYTEA",
    "TEXT": 'TEXT COLLATE "C"',
    " STRICT": "",
}
"""Words of a mission file's schema, and what they are here; only rows of a file have seals."""
_UNSEALED: Final = re.sub(r",\s*seal BLOB NOT NULL", "", SCHEMA)
MISSION: Final = (
    re.sub("|".join(_TYPES), lambda word: _TYPES[word[0]], _UNSEALED).rstrip()
    + """;
CREATE TABLE files (name TEXT COLLATE "C" PRIMARY KEY, content BYTEA NOT NULL);
CREATE TABLE agents (robot TEXT COLLATE "C" PRIMARY KEY, agent TEXT NOT NULL, heard TIMESTAMPTZ NOT NULL)
"""
)


def schema_of(number: int) -> str:
    """Name of a mission's schema."""
    return f"fcslam_mission_{number}"


def prepare(server: Postgres) -> None:
    """Make the tables on a server that has none."""
    with server.connection(f"BEGIN; SELECT pg_advisory_xact_lock({LOCK})") as connection:
        found = connection.execute("SELECT to_regclass('fcslam.version') IS NOT NULL").fetchone()
        if not (found and found[0]):
            connection.execute("CREATE SCHEMA IF NOT EXISTS fcslam")
            connection.execute(f"SET LOCAL search_path TO fcslam; {SHARED}".encode())
            connection.execute("CREATE TABLE fcslam.version (number BIGINT NOT NULL)")
            connection.execute(f"INSERT INTO fcslam.version VALUES ({VERSION})".encode())
        (version,) = connection.execute("SELECT number FROM fcslam.version").fetchone() or (0,)
        if version != VERSION:
            raise StoreError(f"{server.url}: a store of version {version}; this fcslam reads version {VERSION}")
        connection.execute("COMMIT")


def mission_statements(number: int) -> bytes:
    """Statements that make the tables of a new mission."""
    return f"CREATE SCHEMA {schema_of(number)}; SET LOCAL search_path TO {schema_of(number)}; {MISSION}".encode()


class LeaseLostError(InputError):
    """Another worker has the mission."""


class Lease(NamedTuple):
    """The right to be the one worker of a mission."""

    mission: int
    """Number of the mission."""
    fence: int
    """How often the mission had a new worker; the highest one counts."""


class MissionTables(RowStore):
    """The rows of one mission; writers to it wait for each other."""

    def __init__(self, server: Postgres, number: int, lease: Lease | None = None) -> None:
        """Open a mission that exists; a worker gives its ``lease``, and writes nothing after it lost it."""
        super().__init__()
        self._server, self._number, self._lease, self._schema = server, number, lease, schema_of(number)
        self._begin = f"BEGIN; SET LOCAL search_path TO {self._schema}; SELECT pg_advisory_xact_lock({LOCK}, {number})"

    def close(self) -> None:
        """The server's connections stay."""

    @contextmanager
    def transaction(self) -> Iterator[PostgresTransaction]:
        """As in ``RowStore``.

        Raises:
            LeaseLostError: another worker has the mission.
        """
        with self._server.connection(self._begin) as connection:
            transaction = PostgresTransaction(self._server, connection)
            if self._lease is not None:
                check_lease(transaction, self._lease)
            yield transaction
            transaction.execute(  # a worker has to follow the rows; the time, once a minute, keeps it from resting
                "UPDATE fcslam.missions SET is_wanted = true, touched = clock_timestamp() WHERE number = ?"
                " AND (NOT is_wanted OR touched < clock_timestamp() - interval '60 seconds')",
                (self._number,),
            )
            connection.execute("COMMIT")

    def rows(self, statement: str, values: Sequence[object] = ()) -> list[tuple[Any, ...]]:
        """All rows that a query finds."""
        return self._server.rows(statement, values, self._schema)

    def export(self, path: Path) -> None:
        """As in ``RowStore``."""
        rows = path.with_name(f".{path.name}.rows")
        with translate_errors(path):
            rows.unlink(missing_ok=True)
        begin = f"BEGIN ISOLATION LEVEL REPEATABLE READ READ ONLY; SET LOCAL search_path TO {self._schema}"
        try:
            with closing(Database(rows, SCHEMA, FILE_VERSION)) as file:
                # The file is committed without the connection, which may not rest for so long.
                with file.transaction() as written, self._server.connection(begin) as connection:
                    _copy(PostgresTransaction(self._server, connection), written)
                file.export(path)
        finally:
            for left in path.parent.glob(f"{rows.name}*"):
                with suppress(OSError):
                    left.unlink()


def insert_mission(path: Path, transaction: Transaction) -> None:
    """Insert the rows of a mission file that ``check_mission`` passed."""
    with closing(Database(path, SCHEMA, FILE_VERSION, is_checked=True)) as file, file.transaction() as rows:
        _copy(rows, transaction)


def _copy(rows: Transaction, into: Transaction) -> None:
    for table in TABLES:
        into.insert(table, rows.stream(table))


def check_lease(transaction: PostgresTransaction, lease: Lease) -> None:
    """Check that a worker still has its mission, until the end of the transaction.

    A renewal of the lease does not wait for the transaction. A claim leaves the mission out while one is open.

    Raises:
        LeaseLostError: it has not.
    """
    statement = "SELECT fence FROM fcslam.missions WHERE number = ? FOR KEY SHARE"
    if transaction.execute(statement, (lease.mission,)).fetchall() != [(lease.fence,)]:
        raise LeaseLostError(f"mission {lease.mission}: another worker has it")
