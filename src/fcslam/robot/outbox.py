"""Outbox of a robot: numbered packets on disk that the cloud has not confirmed yet.

Each start of a robot begins a session, and so does each loss of its place. The front end numbers the sessions of its
start, and the packets of each. The outbox assigns the numbers on the wire, in the order of sending: the epoch, which
counts the sessions of all starts, and the sequence number. It forgets the data of a packet once the cloud has stored
it, but keeps a digest. By the digests it checks that a recording that is read again produces the same packets.
"""

import hashlib
import secrets
import sqlite3
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

from fcslam.errors import InputError, PacketError, StoreError
from fcslam.records import Channel, DetectorFile, Place
from fcslam.storage.database import Database
from fcslam.wire.batches import LENGTH
from fcslam.wire.limits import MAXIMUM_EPOCH
from fcslam.wire.messages import Packet
from fcslam.wire.packets import encode, readdress

PLACES_SHARE = 0.75
"""Share of the outbox up to which places are accepted; the rest is for packets that the map cannot do without."""

_VERSION = 3
"""Version of the schema and of the packets."""
_SCHEMA = """
CREATE TABLE robot (name TEXT NOT NULL, agent TEXT NOT NULL);
CREATE TABLE sessions (
    epoch INTEGER PRIMARY KEY, session INTEGER NOT NULL, recording TEXT NOT NULL, met INTEGER NOT NULL,
    stored INTEGER NOT NULL
);
CREATE TABLE packets (
    epoch INTEGER NOT NULL, ordinal INTEGER NOT NULL, digest BLOB NOT NULL, sequence INTEGER, data BLOB,
    PRIMARY KEY (epoch, ordinal)
);
CREATE TABLE releases (
    epoch INTEGER NOT NULL, record INTEGER NOT NULL, channel TEXT NOT NULL, version TEXT NOT NULL,
    format INTEGER NOT NULL, size INTEGER NOT NULL, sha256 BLOB NOT NULL
);
CREATE INDEX numbers ON packets (epoch, sequence);
CREATE INDEX waiting ON packets (epoch, sequence) WHERE data IS NOT NULL;
"""
# - session: the front end's own number, 0 for the first session of a start
# - ordinal: the front end's own count
# - sequence: the number on the wire, NULL for a packet that is never sent
# - data: NULL once it need not be sent
# - met: the cloud has confirmed that the epoch belongs to this start
# - stored: number of packets of the epoch, from the first, that the cloud has confirmed
# - releases: detector updates, with the record before which each was applied
_IS_WAITING = "data IS NOT NULL"


class PacketBatch(NamedTuple):
    """The next packets of one epoch to send, oldest first."""

    epoch: int
    first: int
    """Sequence number of the first packet; the others follow without a gap."""
    packets: tuple[bytes, ...]


class WaitingPackets(NamedTuple):
    """Number and size of the packets that are not confirmed yet."""

    packets: int
    bytes: int


class Outbox:
    """Survives a crash of its process at any moment. Two threads may use it, two processes may not."""

    def __init__(self, path: Path, robot: str, limit_bytes: int) -> None:
        self._path = path
        self._limit_bytes = limit_bytes
        self.epoch = self.first_epoch = -1
        """Epochs of the newest session and of the first one of this start."""
        with self._state_errors():
            self._database = Database(path, _SCHEMA, _VERSION, exclusive=True)
        try:
            self.agent = self._agent_of(robot)
            """128 random bits in hexadecimal that identify this file; the cloud distinguishes agents by them."""
            with self._transaction() as connection:
                self.waiting = WaitingPackets(*_count(connection, _IS_WAITING))
                """Packets that are not confirmed yet, of all sessions."""
            self._check_waiting()
        except InputError:
            self.close()
            raise

    def _check_waiting(self) -> None:
        question = (
            "SELECT epoch, session, ordinal, sequence, digest, data FROM packets JOIN sessions USING (epoch) "
            f"WHERE {_IS_WAITING} ORDER BY epoch, sequence"
        )
        for epoch, session, ordinal, sequence, digest, data in self._rows(question):
            try:
                is_whole = _digest(readdress(data, session, ordinal)) == digest
            except PacketError:
                is_whole = False
            if not is_whole:
                raise InputError(
                    f"{self._path}: packet {sequence} of epoch {epoch} is damaged, and later packets depend on "
                    "it; give another --state"
                )

    def close(self) -> None:
        """Close the file; waiting packets stay in it."""
        self._database.close()

    def begin(self, recording: str, resume: bool) -> int:
        """Start to read a recording with this fingerprint: in a new epoch, or resumed where it was interrupted.

        Returns the number of packets that the front end will produce again; 0 if nothing is resumed.
        """
        with self._transaction() as connection:
            last, before = _one(connection, "SELECT max(epoch), recording FROM sessions WHERE session = 0")
            if resume and last is not None:
                if before != recording:
                    raise InputError(
                        f"{self._path}: left by another recording, other settings or another version; "
                        "leave --resume out to start anew"
                    )
                self.first_epoch = int(last)
                (self.epoch,) = _one(connection, "SELECT max(epoch) FROM sessions")
            else:
                connection.execute("DELETE FROM packets WHERE data IS NULL")
                self.first_epoch = self._open_session(connection, 0, recording)
            return int(_one(connection, "SELECT count(*) FROM packets WHERE epoch >= ?", self.first_epoch)[0])

    @property
    def is_synchronized(self) -> bool:
        """Whether the cloud has confirmed every session; packets of other sessions are not sent."""
        return not self._rows("SELECT 1 FROM sessions WHERE met = 0 LIMIT 1")

    def session_of(self, epoch: int) -> int | None:
        """The session of this start with this epoch; None for epochs of earlier starts."""
        rows = self._rows("SELECT session FROM sessions WHERE epoch = ? AND epoch >= ?", (epoch, self.first_epoch))
        return int(rows[0][0]) if rows else None

    @property
    def is_full(self) -> bool:
        """Whether the front end has to wait before it adds packets."""
        return self.waiting.bytes >= self._limit_bytes

    def put(self, packets: Iterable[Packet]) -> int:
        """Add the next packets of the front end. Packets that were added before an interruption are skipped.

        Places are dropped if the outbox is crowded: the map loses chances to close loops, but its chain stays whole.
        Returns their number.
        """
        dropped = 0
        with self._transaction() as connection:
            for packet in packets:
                epoch = self._epoch_of(connection, packet.epoch)
                data = encode(packet)
                digest = _digest(data)
                if self._is_known(connection, epoch, packet.sequence, digest):
                    continue
                crowded = self.waiting.bytes >= PLACES_SHARE * self._limit_bytes
                number = sent = None
                if crowded and isinstance(packet.body, Place):
                    dropped += 1
                else:
                    numbers = "SELECT coalesce(max(sequence) + 1, 0) FROM packets WHERE epoch = ?"
                    (number,) = _one(connection, numbers, epoch)
                    sent = readdress(data, epoch, number)
                    self.waiting = WaitingPackets(self.waiting.packets + 1, self.waiting.bytes + len(sent))
                row = epoch, packet.sequence, digest, number, sent
                connection.execute("INSERT INTO packets VALUES (?, ?, ?, ?, ?)", row)
        return dropped

    def record_detector_update(self, record: int, file: DetectorFile) -> None:
        """Store that the front end applied a detector update before this record of the session."""
        row = (self.epoch, record, file.channel.value, file.version, file.format, file.size, file.sha256)
        with self._transaction() as connection:
            connection.execute("INSERT INTO releases VALUES (?, ?, ?, ?, ?, ?, ?)", row)

    def detector_updates(self) -> dict[int, DetectorFile]:
        """The detector updates that this start has applied, by record."""
        columns = "record, channel, version, format, size, sha256"
        rows = self._rows(f"SELECT {columns} FROM releases WHERE epoch >= ?", (self.first_epoch,))
        return {record: DetectorFile(Channel(channel), *rest) for record, channel, *rest in rows}

    def batch(self, maximum_bytes: int, maximum_packets: int) -> PacketBatch | None:
        """The oldest waiting packets of confirmed sessions that fit one batch, at least one; None if none waits."""
        question = (
            f"SELECT epoch, sequence, data FROM packets JOIN sessions USING (epoch) WHERE {_IS_WAITING} AND met = 1 "
            "ORDER BY epoch, sequence LIMIT ?"
        )
        chosen: list[tuple[int, int, bytes]] = []
        size = 0
        with self._transaction() as connection:
            for row in connection.execute(question, (maximum_packets,)):
                size += LENGTH.size + len(row[2])
                if chosen and (size > maximum_bytes or row[0] != chosen[0][0]):
                    break
                chosen.append(row)
        return PacketBatch(chosen[0][0], chosen[0][1], tuple(data for _, _, data in chosen)) if chosen else None

    def synchronize(self, expected: Mapping[int, int]) -> list[tuple[int, int]]:
        """Compare the sessions with those of the cloud.

        Sessions that the cloud has not seen move to epochs above all that it has: the robot may have had another state
        folder before. ``expected`` is the next sequence number that the cloud expects, by epoch. Returns epoch and
        sequence number of waiting packets that the cloud can no longer use: those of earlier sessions whose first
        packets it had confirmed and does not have any more.
        """
        with self._transaction() as connection:
            newest = max(expected, default=-1)
            moves = []
            for (epoch,) in connection.execute("SELECT epoch FROM sessions WHERE met = 0 ORDER BY epoch"):
                newest = max(epoch, newest + 1)
                moves.append((epoch, newest))
            if newest > MAXIMUM_EPOCH:
                raise InputError(
                    f"{self._path}: the cloud has packets of epoch {max(expected)} of this robot, and epochs end at "
                    f"{MAXIMUM_EPOCH}: something else sends under its name; replace its token and start a new mission"
                )
            for move in reversed(moves):
                self._move(connection, *move)
            connection.execute("UPDATE sessions SET met = 1")
            sessions = connection.execute("SELECT epoch, stored FROM sessions ORDER BY epoch")
            broken = {epoch: stored for epoch, stored in sessions if expected.get(epoch, 0) < stored}
            if self.epoch in broken:
                had, has = broken[self.epoch], expected.get(self.epoch, 0)
                raise InputError(
                    f"{self._path}: the cloud has {has} of {had} packets of epoch {self.epoch} that were confirmed, so "
                    "its mission is another one; start anew: without --resume, or with another --state"
                )
            waiting = connection.execute(
                f"SELECT epoch, sequence FROM packets WHERE {_IS_WAITING} ORDER BY epoch, sequence"
            )
            return [(epoch, sequence) for epoch, sequence in waiting if epoch in broken]

    def acknowledge(self, epoch: int, sequence: int) -> int:
        """Forget all packets of ``epoch`` up to ``sequence``, which the cloud has stored. Returns their number."""
        stored = "UPDATE sessions SET stored = max(stored, ?) WHERE epoch = ?"
        with self._transaction() as connection:
            connection.execute(stored, (sequence + 1, epoch))
            return self._forget(connection, f"epoch = {epoch:d} AND sequence <= {sequence:d} AND {_IS_WAITING}")

    def packet(self, epoch: int, sequence: int) -> bytes | None:
        """A waiting packet; None if it does not wait."""
        question = f"SELECT data FROM packets WHERE epoch = ? AND sequence = ? AND {_IS_WAITING}"
        rows = self._rows(question, (epoch, sequence))
        return bytes(rows[0][0]) if rows else None

    def drop(self, epoch: int, sequence: int) -> None:
        """Forget a packet that the cloud refuses; it keeps its sequence number."""
        with self._transaction() as connection:
            self._forget(connection, f"epoch = {epoch:d} AND sequence = {sequence:d} AND {_IS_WAITING}")

    def _forget(self, connection: sqlite3.Connection, which: str) -> int:
        count, size = _count(connection, which)
        connection.execute(f"UPDATE packets SET data = NULL WHERE {which}")
        self.waiting = WaitingPackets(self.waiting.packets - count, self.waiting.bytes - size)
        return count

    def _move(self, connection: sqlite3.Connection, epoch: int, to: int) -> None:
        rows = connection.execute("SELECT ordinal, sequence, data FROM packets WHERE epoch = ?", (epoch,)).fetchall()
        for ordinal, sequence, data in rows:
            if data is not None:
                moved = readdress(data, to, sequence)
                connection.execute(
                    "UPDATE packets SET data = ? WHERE epoch = ? AND ordinal = ?", (moved, epoch, ordinal)
                )
        for table in ("packets", "sessions", "releases"):
            connection.execute(f"UPDATE {table} SET epoch = ? WHERE epoch = ?", (to, epoch))
        self.waiting = WaitingPackets(*_count(connection, _IS_WAITING))
        self.epoch = to if self.epoch == epoch else self.epoch
        self.first_epoch = to if self.first_epoch == epoch else self.first_epoch

    def _agent_of(self, robot: str) -> str:
        with self._transaction() as connection:
            row = _one(connection, "SELECT name, agent FROM robot")
            if row is None:
                row = robot, secrets.token_hex(16)
                connection.execute("INSERT INTO robot VALUES (?, ?)", row)
        if row[0] != robot:
            raise InputError(f"{self._path}: belongs to robot '{row[0]}', not '{robot}'; give each its own --state")
        return str(row[1])

    def _open_session(self, connection: sqlite3.Connection, session: int, recording: str) -> int:
        (self.epoch,) = _one(connection, "SELECT coalesce(max(epoch) + 1, 0) FROM sessions")
        connection.execute("INSERT INTO sessions VALUES (?, ?, ?, 0, 0)", (self.epoch, session, recording))
        return self.epoch

    def _epoch_of(self, connection: sqlite3.Connection, session: int) -> int:
        row = _one(connection, "SELECT epoch FROM sessions WHERE session = ? AND epoch >= ?", session, self.first_epoch)
        if row is not None:
            return int(row[0])
        (recording,) = _one(connection, "SELECT recording FROM sessions WHERE epoch = ?", self.first_epoch)
        return self._open_session(connection, session, recording)

    def _is_known(self, connection: sqlite3.Connection, epoch: int, ordinal: int, digest: bytes) -> bool:
        row = _one(connection, "SELECT digest FROM packets WHERE epoch = ? AND ordinal = ?", epoch, ordinal)
        if row is not None and row[0] != digest:
            raise InputError(
                f"{self._path}: packet {ordinal} differs from that of the interrupted run; leave --resume out"
            )
        return row is not None

    def _rows(self, question: str, values: Sequence[object] = ()) -> list[tuple[Any, ...]]:
        with self._state_errors():
            return self._database.rows(question, values)

    @contextmanager
    def _transaction(self) -> Iterator[sqlite3.Connection]:
        with self._state_errors(), self._database.transaction() as connection:
            yield connection

    @contextmanager
    def _state_errors(self) -> Iterator[None]:
        try:
            yield
        except StoreError as error:
            if error.__cause__ is None:
                raise InputError(f"{self._path}: comes from another version of fcslam; give another --state") from error
            reason = " ".join(str(error.__cause__).split())
            reason = "another process runs on it" if reason == "database is locked" else reason
            raise InputError(f"{self._path}: cannot be used: {reason}; give another --state") from error


def _digest(data: bytes) -> bytes:
    return hashlib.blake2b(data, digest_size=8).digest()


def _count(connection: sqlite3.Connection, which: str) -> tuple[int, int]:
    count, size = _one(connection, f"SELECT count(*), coalesce(sum(length(data)), 0) FROM packets WHERE {which}")
    return int(count), int(size)


def _one(connection: sqlite3.Connection, question: str, *values: object) -> Any:
    return connection.execute(question, values).fetchone()
