"""A mission on a PostgreSQL server: the rows of a mission file, and what its worker leaves for other instances."""

from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager, suppress
from pathlib import Path
from typing import Any, NamedTuple

from fcslam.errors import InputError
from fcslam.mission.mission_store import SCHEMA, TABLES, VERSION
from fcslam.service.shared.schema import LOCK, schema_of
from fcslam.storage.database import Database, translate_errors
from fcslam.storage.postgres import Postgres, PostgresTransaction
from fcslam.storage.row_store import RowStore


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
            transaction = PostgresTransaction(connection)
            if self._lease is not None:
                check_lease(transaction, self._lease)
            else:  # a worker has to follow the rows that an instance writes
                transaction.execute(
                    "UPDATE fcslam.missions SET is_wanted = true WHERE number = ? AND NOT is_wanted", (self._number,)
                )
            yield transaction
            connection.execute("COMMIT")

    def rows(self, statement: str, values: Sequence[object] = ()) -> list[tuple[Any, ...]]:
        """All rows that a query finds."""
        return self._server.rows(statement, values, self._schema)

    @contextmanager
    def _snapshot(self) -> Iterator[PostgresTransaction]:
        """Read several tables as they are at one moment."""
        begin = f"BEGIN ISOLATION LEVEL REPEATABLE READ READ ONLY; SET LOCAL search_path TO {self._schema}"
        with self._server.connection(begin) as connection:
            yield PostgresTransaction(connection)
            connection.execute("COMMIT")

    def import_mission(self, path: Path) -> None:
        """Insert the rows of a mission file into a mission that has none."""
        with closing(Database(path, SCHEMA, VERSION)) as file, self.transaction() as transaction:
            for table in TABLES:
                columns, key = ", ".join(table.columns), ", ".join(table.key)
                rows = file.rows(f"SELECT {columns} FROM {table.name} ORDER BY {key}")
                transaction.insert(table, rows)

    def export(self, path: Path) -> None:
        """As in ``RowStore``."""
        rows = path.with_name(f".{path.name}.rows")
        with translate_errors(path):
            rows.unlink(missing_ok=True)
        try:
            with closing(Database(rows, SCHEMA, VERSION)) as file:
                with self._snapshot() as found, file.transaction() as transaction:
                    for table in TABLES:
                        transaction.insert(table, found.stream(table))
                file.export(path)
        finally:
            for left in path.parent.glob(f"{rows.name}*"):
                with suppress(OSError):
                    left.unlink()


def check_lease(transaction: PostgresTransaction, lease: Lease) -> None:
    """Check that a worker still has its mission, until the end of the transaction.

    A renewal of the lease does not wait for the transaction. A claim leaves the mission out while one is open.

    Raises:
        LeaseLostError: it has not.
    """
    statement = "SELECT fence FROM fcslam.missions WHERE number = ? FOR KEY SHARE"
    if transaction.execute(statement, (lease.mission,)).fetchall() != [(lease.fence,)]:
        raise LeaseLostError(f"mission {lease.mission}: another worker has it")
