"""Which missions there are on a server, which instances, and which of them has the worker of each mission.

All times are of the server's clock, so a wrong clock of an instance does no harm.
"""

from collections.abc import Callable, Sequence
from typing import Final, NamedTuple

from fcslam.errors import InputError
from fcslam.service.shared.mission_tables import Lease, mission_statements
from fcslam.storage.postgres import Postgres, PostgresTransaction

LEASE_S: Final = 3.0
"""An instance that does not renew its leases for so long loses them."""
_READ: Final = """
SELECT number, name, is_open, is_wanted, holder, expires > clock_timestamp(), is_ready, live, finalized
FROM missions ORDER BY name
"""


class KnownMission(NamedTuple):
    """A mission on the server."""

    number: int
    name: str
    is_open: bool
    """Whether robots that name no mission send to it."""
    is_wanted: bool
    """Whether it needs a worker."""
    holder: str | None
    """Instance that has its worker, or had it last."""
    is_held: bool
    """Whether that instance renewed its lease in time."""
    is_ready: bool
    """Whether its worker has compiled its code."""
    live: int
    """How often there was a new live run."""
    finalized: int
    """How often there was a new result."""


class Registry:
    """Missions, leases and instances, as one instance sees them.

    Raises:
        StoreError: from every method: the server cannot be used now.
    """

    def __init__(self, server: Postgres, instance: str, process: str, lease_s: float = LEASE_S) -> None:
        """``process``: a random name of this process, to tell it from another one with the same ``instance``."""
        self._server, self._instance, self._process, self.lease_s = server, instance, process, lease_s
        self._expiry = f"clock_timestamp() + interval '{lease_s} seconds'"

    def register(self, room: int) -> bool:
        """Take this instance's name, or renew it, and say how many missions it takes; False: another process has it."""
        taken = self._server.rows(
            f"INSERT INTO instances VALUES (?, ?, ?, {self._expiry}) ON CONFLICT (name) DO UPDATE"
            f" SET process = excluded.process, room = excluded.room, expires = {self._expiry}"
            " WHERE instances.process = excluded.process OR instances.expires < clock_timestamp() RETURNING 1",
            (self._instance, self._process, room),
        )
        return bool(taken)

    def leave(self) -> None:
        """Give up this instance's name."""
        self._server.rows(
            "DELETE FROM instances WHERE name = ? AND process = ? RETURNING 1", (self._instance, self._process)
        )

    def rooms(self) -> list[int]:
        """How many missions each instance takes that there is now."""
        return [room for (room,) in self._server.rows("SELECT room FROM instances WHERE expires > clock_timestamp()")]

    def missions(self) -> list[KnownMission]:
        """All missions, by name."""
        return [KnownMission(*row) for row in self._server.rows(_READ)]

    def create(self, name: str, fill: Callable[[PostgresTransaction], None] | None = None) -> int:
        """Create a mission; returns its number. ``fill`` inserts its rows; if it fails, there is no mission.

        A mission without a row in its tables needs no worker.
        """
        exists = InputError(f"mission '{name}' exists; open it or choose another name")
        with self._server.connection("BEGIN; SET LOCAL search_path TO fcslam") as connection:
            transaction = PostgresTransaction(self._server, connection)
            if transaction.execute("SELECT 1 FROM missions WHERE name = ?", (name,)).fetchall():
                raise exists
            counter = "SELECT nextval(pg_get_serial_sequence('missions', 'number'))"
            ((number,),) = transaction.execute(counter).fetchall()
            connection.execute(mission_statements(number))
            if fill is not None:
                fill(transaction)
            # Only now, as whoever opens a mission waits for this row.
            new = transaction.execute(
                "INSERT INTO fcslam.missions (number, name, is_wanted) OVERRIDING SYSTEM VALUE VALUES (?, ?, ?)"
                " ON CONFLICT DO NOTHING RETURNING 1",
                (number, name, fill is not None),
            )
            if not new.fetchall():
                raise exists
            connection.execute("COMMIT")
        return int(number)

    def open(self, number: int) -> None:
        """Let robots that name no mission send to this one."""
        with self._server.connection("BEGIN; LOCK TABLE fcslam.missions IN SHARE ROW EXCLUSIVE MODE") as connection:
            connection.execute("UPDATE fcslam.missions SET is_open = false WHERE is_open")
            connection.execute(
                "UPDATE fcslam.missions SET is_open = true, is_wanted = true, touched = clock_timestamp()"
                " WHERE number = %s",
                (number,),
            )
            connection.execute("COMMIT")

    def claim(self, most: int) -> list[Lease]:
        """Take up to ``most`` missions that need a worker and have none, each with a new fencing number.

        The open mission comes first, then those in which something happened last.
        """
        claimed = self._server.rows(
            "UPDATE missions SET holder = ?, fence = fence + 1, is_ready = false, touched = clock_timestamp(),"
            f" expires = {self._expiry} WHERE number IN (SELECT number FROM missions"
            " WHERE is_wanted AND expires < clock_timestamp() ORDER BY is_open DESC, touched DESC LIMIT ?"
            " FOR UPDATE SKIP LOCKED)"
            " RETURNING number, fence",
            (self._instance, most),
        )
        return [Lease(*row) for row in claimed]

    def renew(self, leases: Sequence[tuple[Lease, bool]]) -> set[Lease]:
        """Renew leases, and note whether each worker is ready; returns those that are still this instance's."""
        if not leases:
            return set()
        missions, fences, ready = zip(*((*lease, is_ready) for lease, is_ready in leases), strict=True)
        renewed = self._server.rows(
            f"UPDATE missions SET expires = {self._expiry}, is_ready = mine.is_ready"
            " FROM unnest(CAST(? AS BIGINT[]), CAST(? AS BIGINT[]), CAST(? AS BOOLEAN[]))"
            " AS mine (number, fence, is_ready)"
            " WHERE missions.number = mine.number AND missions.fence = mine.fence"
            " RETURNING missions.number, missions.fence",
            (list(missions), list(fences), list(ready)),
        )
        return {Lease(*row) for row in renewed}

    def release(self, lease: Lease) -> None:
        """Give up a mission whose worker has ended; another instance may take it."""
        self._server.rows(
            "UPDATE missions SET expires = '-infinity', is_ready = false WHERE number = ? AND fence = ? RETURNING 1",
            (lease.mission, lease.fence),
        )

    def let_rest(self) -> None:
        """Note which missions need no worker: those for which one wrote nothing for half an hour, and nobody else."""
        self._server.rows(
            "UPDATE missions SET is_wanted = false WHERE is_wanted AND expires > clock_timestamp()"
            " AND touched < clock_timestamp() - interval '30 minutes' RETURNING 1"
        )
