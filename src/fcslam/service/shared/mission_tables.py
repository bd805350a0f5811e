"""A mission on a PostgreSQL server: the rows of a mission file, and what its worker leaves for other instances."""

from collections.abc import Iterable
from contextlib import closing, suppress
from pathlib import Path
from typing import Any, NamedTuple

from fcslam.errors import ServiceError
from fcslam.mission.mission_store import SCHEMA, TABLES, VERSION
from fcslam.service.shared.schema import schema_of
from fcslam.storage.database import Database, translate_errors
from fcslam.storage.postgres import Postgres, PostgresTables, PostgresTransaction


class LeaseLostError(ServiceError):
    """Another worker has the mission."""


class Lease(NamedTuple):
    """The right to be the one worker of a mission."""

    mission: int
    """Number of the mission."""
    fence: int
    """How often the mission had a new worker; the highest one counts."""


class MissionTables(PostgresTables):
    """The rows of one mission, as a ``RowStore``."""

    def __init__(self, server: Postgres, number: int, lease: Lease | None = None) -> None:
        """Open a mission that exists; a worker gives its ``lease``, and writes nothing after it lost it."""
        self._number, self._lease = number, lease
        super().__init__(server, schema_of(number), number, self._check)

    def _check(self, transaction: PostgresTransaction) -> None:
        """Raises:
        LeaseLostError: another worker has the mission.
        """
        if self._lease is None:
            # A worker has to follow the rows that an instance writes.
            transaction.execute(
                "UPDATE fcslam.missions SET is_wanted = true WHERE number = ? AND NOT is_wanted", (self._number,)
            )
        else:
            check_lease(transaction, self._lease)

    def import_mission(self, path: Path) -> None:
        """Insert the rows of a mission file into a mission that has none.

        Raises:
            StoreError: the file or the server cannot be used; nothing was inserted.
        """
        with closing(Database(path, SCHEMA, VERSION)) as file, self.transaction() as transaction:
            for table in TABLES:
                columns, key = ", ".join(table.columns), ", ".join(table.key)
                rows = file.rows(f"SELECT {columns} FROM {table.name} ORDER BY {key}")
                transaction.insert(table, rows)

    def export(self, path: Path) -> None:
        """Write the mission as one new mission file, atomically.

        Raises:
            StoreError: there is a file already, or it cannot be written.
        """
        rows = path.with_name(f".{path.name}.rows")
        with translate_errors(path):
            rows.unlink(missing_ok=True)
        try:
            with closing(Database(rows, SCHEMA, VERSION)) as file:
                with self.snapshot() as found, file.transaction() as transaction:
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
    found: Iterable[Any] = transaction.execute(statement, (lease.mission,)).fetchall()
    if list(found) != [(lease.fence,)]:
        raise LeaseLostError(f"mission {lease.mission}: another worker has it")
