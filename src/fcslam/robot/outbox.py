"""What a robot has to say and the cloud has not yet confirmed: numbered packets on disk.

A start of the robot is an epoch, and whenever it was lost on the way another one begins: the start's next part. The
front end counts parts, and the packets of each; here they get the epoch and the sequence by which they travel, in the
order in which they leave. A packet is forgotten once the cloud has stored it; a digest of it stays, by which a
recording that is read again is known to say the same.
"""

import hashlib
import secrets
import sqlite3
import threading
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

from fcslam.errors import StateError
from fcslam.records import Channel, DetectorFile, Place
from fcslam.wire.batches import LENGTH
from fcslam.wire.messages import Packet
from fcslam.wire.packets import encode, readdress

PLACES_SHARE = 0.75
"""Share of the outbox up to which places are taken: the rest is for what the map cannot do without."""

_VERSION = 1
"""Of the schema; with another one goes another number."""
_SCHEMA = f"""
PRAGMA user_version = {_VERSION};
CREATE TABLE IF NOT EXISTS robot (name TEXT NOT NULL, agent TEXT NOT NULL);
CREATE TABLE IF NOT EXISTS sessions (
    epoch INTEGER PRIMARY KEY, part INTEGER NOT NULL, recording TEXT NOT NULL, met INTEGER NOT NULL,
    stored INTEGER NOT NULL
);
CREATE TABLE IF NOT EXISTS packets (
    epoch INTEGER NOT NULL, ordinal INTEGER NOT NULL, digest BLOB NOT NULL, sequence INTEGER, data BLOB,
    PRIMARY KEY (epoch, ordinal)
);
CREATE TABLE IF NOT EXISTS releases (
    epoch INTEGER NOT NULL, record INTEGER NOT NULL, channel TEXT NOT NULL, version TEXT NOT NULL,
    format INTEGER NOT NULL, size INTEGER NOT NULL, sha256 BLOB NOT NULL
);
CREATE INDEX IF NOT EXISTS numbers ON packets (epoch, sequence);
CREATE INDEX IF NOT EXISTS waiting ON packets (epoch, sequence) WHERE data IS NOT NULL;
"""
# part: the front end's own epoch, 0 where a start begins; ordinal: the front end's own count; sequence: the number on
# the wire, NULL of a packet that never travels; data: NULL once it need not be sent; met: the cloud has confirmed that
# the epoch belongs to this start; stored: packets of the epoch, from its first, that the cloud has confirmed.


class PacketBatch(NamedTuple):
    """Packets of one epoch that travel next, oldest first."""

    epoch: int
    first: int
    """Sequence of the first; those after it have the next ones."""
    packets: tuple[bytes, ...]


class WaitingPackets(NamedTuple):
    """What is not confirmed yet."""

    packets: int
    bytes: int


class Outbox:
    """Survives its process at any instant. Two threads may use it, two processes may not."""

    def __init__(self, path: Path, robot: str, limit_bytes: int) -> None:
        """Open the file at ``path``, or make it.

        Raises:
            StateError: it belongs to another robot, another process has it, it is no outbox or cannot be written.
        """
        self._path = path
        self._limit_bytes = limit_bytes
        self._lock = threading.Lock()
        self.epoch = -1
        """Of the newest session."""
        self._first = -1
        """Epoch with which the start began."""
        with _in_words(path):
            self._database = sqlite3.connect(path, timeout=0.0, check_same_thread=False)
        try:
            self.agent = self._open(robot)
            """128 random bits in hexadecimal that stand for this file: the cloud tells agents apart by them."""
        except StateError:
            self.close()
            raise
        self.waiting = WaitingPackets(*self._count("data IS NOT NULL"))
        """What is not confirmed yet, of all sessions."""

    def close(self) -> None:
        """Let go of the file; what waits in it stays."""
        self._database.close()

    def begin(self, recording: str, resume: bool) -> int:
        """Start to read ``recording`` (a fingerprint of it): with a new epoch, or as the last time once more.

        Returns how many packets the front end will say again: 0 unless there is something to resume.

        Raises:
            StateError: it was another recording.
        """
        with self._transaction():
            last, before = self._one("SELECT max(epoch), recording FROM sessions WHERE part = 0")
            if resume and last is not None:
                if before != recording:
                    raise StateError(
                        f"{self._path}: left by another recording, other settings or another version; "
                        "leave --resume out to start anew"
                    )
                self._first = int(last)
                (self.epoch,) = self._one("SELECT max(epoch) FROM sessions")
            else:
                self._first = self._open_session(0, recording)
            return int(self._one("SELECT count(*) FROM packets WHERE epoch >= ?", self._first)[0])

    @property
    def is_synchronized(self) -> bool:
        """Whether the cloud knows every session: packets of others do not travel."""
        with self._transaction():
            return self._one("SELECT 1 FROM sessions WHERE met = 0") is None

    def part(self, epoch: int) -> int | None:
        """Which part of this start an epoch is; None: of an earlier one."""
        with self._transaction():
            row = self._one("SELECT part FROM sessions WHERE epoch = ? AND epoch >= ?", epoch, self._first)
        return None if row is None else int(row[0])

    @property
    def is_full(self) -> bool:
        """Whether the next packets have to wait outside."""
        return self.waiting.bytes >= self._limit_bytes

    def put(self, packets: Iterable[Packet]) -> int:
        """Take the front end's next packets of this epoch; what it said before it was resumed counts once.

        Returns how many places were left out because too much waits: the map loses chances to close loops, but no
        part of its chain.

        Raises:
            StateError: the front end said something else before: it is not the recording that is resumed.
        """
        left_out = 0
        with self._transaction():
            for packet in packets:
                epoch = self._epoch_of(packet.epoch)
                data = encode(packet)
                digest = hashlib.blake2b(data, digest_size=8).digest()
                if self._is_known(epoch, packet.sequence, digest):
                    continue
                crowded = self.waiting.bytes >= PLACES_SHARE * self._limit_bytes
                if crowded and isinstance(packet.body, Place):
                    self._insert(epoch, packet.sequence, digest, None, None)
                    left_out += 1
                    continue
                (number,) = self._one("SELECT coalesce(max(sequence) + 1, 0) FROM packets WHERE epoch = ?", epoch)
                sent = readdress(data, epoch, number)
                self._insert(epoch, packet.sequence, digest, number, sent)
                self.waiting = WaitingPackets(self.waiting.packets + 1, self.waiting.bytes + len(sent))
        return left_out

    def record_detector_update(self, record: int, file: DetectorFile) -> None:
        """Remember that the front end takes a detector before this record of the session."""
        told = (self.epoch, record, file.channel.value, file.version, file.format, file.size, file.sha256)
        with self._transaction():
            self._database.execute("INSERT INTO releases VALUES (?, ?, ?, ?, ?, ?, ?)", told)

    def detector_updates(self) -> dict[int, DetectorFile]:
        """What the start has taken, by record."""
        columns = "record, channel, version, format, size, sha256"
        with self._transaction():
            rows = self._database.execute(f"SELECT {columns} FROM releases WHERE epoch >= ?", (self._first,)).fetchall()
        return {record: DetectorFile(Channel(channel), *rest) for record, channel, *rest in rows}

    def batch(self, maximum_bytes: int, maximum_packets: int) -> PacketBatch | None:
        """The oldest waiting packets of sessions that were met that fit one batch, at least one; None if none waits."""
        question = (
            "SELECT epoch, sequence, data FROM packets JOIN sessions USING (epoch) WHERE data IS NOT NULL AND met = 1 "
            "ORDER BY epoch, sequence LIMIT ?"
        )
        chosen: list[tuple[int, int, bytes]] = []
        size = 0
        with self._transaction():
            for row in self._database.execute(question, (maximum_packets,)):
                size += LENGTH.size + len(row[2])
                if chosen and (size > maximum_bytes or row[0] != chosen[0][0]):
                    break
                chosen.append(row)
        return PacketBatch(chosen[0][0], chosen[0][1], tuple(data for _, _, data in chosen)) if chosen else None

    def synchronize(self, expected: Mapping[int, int]) -> list[tuple[int, int]]:
        """Learn what the cloud has of this robot: the next sequence that it expects, by epoch.

        Sessions that it has not seen move to epochs above all that it has: the robot may have had another state folder.
        Returns epoch and sequence of packets that wait in vain: those of earlier sessions whose beginning the cloud had
        confirmed and now lacks.

        Raises:
            StateError: the cloud lacks the beginning of this epoch.
        """
        with self._transaction():
            newest = max(expected, default=-1)
            moves = []
            for (epoch,) in self._database.execute("SELECT epoch FROM sessions WHERE met = 0 ORDER BY epoch"):
                newest = max(epoch, newest + 1)
                moves.append((epoch, newest))
            for move in reversed(moves):
                self._move(*move)
            self._database.execute("UPDATE sessions SET met = 1")
            sessions = self._database.execute("SELECT epoch, stored FROM sessions ORDER BY epoch")
            broken = {epoch: stored for epoch, stored in sessions if expected.get(epoch, 0) < stored}
            if self.epoch in broken:
                had, has = broken[self.epoch], expected.get(self.epoch, 0)
                raise StateError(
                    f"{self._path}: the cloud has {has} of {had} packets of epoch {self.epoch} that were confirmed, so "
                    "its mission is another one; start anew: without --resume, or with another --state"
                )
            waiting = self._database.execute(
                "SELECT epoch, sequence FROM packets WHERE data IS NOT NULL ORDER BY epoch, sequence"
            )
            return [(epoch, sequence) for epoch, sequence in waiting if epoch in broken]

    def acknowledge(self, epoch: int, sequence: int) -> int:
        """The cloud has all packets of ``epoch`` up to ``sequence``: forget them. Returns how many they were."""
        gone = f"epoch = {epoch:d} AND sequence <= {sequence:d} AND data IS NOT NULL"
        with self._transaction():
            self._database.execute("UPDATE sessions SET stored = max(stored, ?) WHERE epoch = ?", (sequence + 1, epoch))
            return self._forget(gone)

    def packet(self, epoch: int, sequence: int) -> bytes | None:
        """A packet that waits; None if it does not."""
        question = "SELECT data FROM packets WHERE epoch = ? AND sequence = ? AND data IS NOT NULL"
        with self._transaction():
            row = self._one(question, epoch, sequence)
        return None if row is None else bytes(row[0])

    def drop(self, epoch: int, sequence: int) -> None:
        """Forget a packet that the cloud will never take, but whose number it counts as used."""
        which = f"epoch = {epoch:d} AND sequence = {sequence:d} AND data IS NOT NULL"
        with self._transaction():
            self._forget(which)

    def _forget(self, which: str) -> int:
        """These need not be sent any more. Returns how many they were."""
        count, size = self._count(which)
        self._database.execute(f"UPDATE packets SET data = NULL WHERE {which}")
        self.waiting = WaitingPackets(self.waiting.packets - count, self.waiting.bytes - size)
        return count

    def _move(self, epoch: int, to: int) -> None:
        """Another epoch for a session of which the cloud has nothing."""
        rows = self._database.execute(
            "SELECT ordinal, sequence, data FROM packets WHERE epoch = ?", (epoch,)
        ).fetchall()
        for ordinal, sequence, data in rows:
            if data is not None:
                moved = readdress(data, to, sequence)
                self._database.execute(
                    "UPDATE packets SET data = ? WHERE epoch = ? AND ordinal = ?", (moved, epoch, ordinal)
                )
        for table in ("packets", "sessions", "releases"):
            self._database.execute(f"UPDATE {table} SET epoch = ? WHERE epoch = ?", (to, epoch))
        self.waiting = WaitingPackets(*self._count("data IS NOT NULL"))
        self.epoch = to if self.epoch == epoch else self.epoch
        self._first = to if self._first == epoch else self._first

    def _open(self, robot: str) -> str:
        """Whose file it is is settled first; returns its agent."""
        with self._transaction():
            # Without more syncs a power cut may take the last packets; a recording makes them again.
            for pragma in ("locking_mode = EXCLUSIVE", "journal_mode = WAL", "synchronous = NORMAL"):
                self._database.execute(f"PRAGMA {pragma}")
            (tables,), (version,) = self._one("SELECT count(*) FROM sqlite_master"), self._one("PRAGMA user_version")
            if tables and version != _VERSION:
                raise StateError(f"{self._path}: is of another version of fcslam; give another --state")
            self._database.executescript(_SCHEMA)
            row = self._one("SELECT name, agent FROM robot")
            if row is None:
                row = robot, secrets.token_hex(16)
                self._database.execute("INSERT INTO robot VALUES (?, ?)", row)
        if row[0] != robot:
            raise StateError(f"{self._path}: belongs to robot '{row[0]}', not '{robot}'; give each its own --state")
        return str(row[1])

    def _open_session(self, part: int, recording: str) -> int:
        (self.epoch,) = self._one("SELECT coalesce(max(epoch) + 1, 0) FROM sessions")
        self._database.execute("INSERT INTO sessions VALUES (?, ?, ?, 0, 0)", (self.epoch, part, recording))
        return self.epoch

    def _epoch_of(self, part: int) -> int:
        """Epoch of a part of this start, which begins now if it had not."""
        row = self._one("SELECT epoch FROM sessions WHERE part = ? AND epoch >= ?", part, self._first)
        if row is not None:
            return int(row[0])
        (recording,) = self._one("SELECT recording FROM sessions WHERE epoch = ?", self._first)
        return self._open_session(part, recording)

    def _is_known(self, epoch: int, ordinal: int, digest: bytes) -> bool:
        row = self._one("SELECT digest FROM packets WHERE epoch = ? AND ordinal = ?", epoch, ordinal)
        if row is not None and row[0] != digest:
            raise StateError(
                f"{self._path}: packet {ordinal} is not what this recording said before; leave --resume out"
            )
        return row is not None

    def _insert(self, epoch: int, ordinal: int, digest: bytes, sequence: int | None, data: bytes | None) -> None:
        self._database.execute("INSERT INTO packets VALUES (?, ?, ?, ?, ?)", (epoch, ordinal, digest, sequence, data))

    def _count(self, which: str) -> tuple[int, int]:
        """Packets and their bytes."""
        count, size = self._one(f"SELECT count(*), coalesce(sum(length(data)), 0) FROM packets WHERE {which}")
        return int(count), int(size)

    def _one(self, question: str, *parameters: object) -> Any:
        return self._database.execute(question, parameters).fetchone()

    @contextmanager
    def _transaction(self) -> Iterator[None]:
        """Alone in the file; all of it or nothing."""
        with self._lock, _in_words(self._path), self._database:
            yield


@contextmanager
def _in_words(path: Path) -> Iterator[None]:
    """What SQLite refuses, in one line."""
    try:
        yield
    except sqlite3.Error as error:
        reasons = {"database is locked": "another process runs on it"}
        raise StateError(f"{path}: cannot be used: {reasons.get(str(error), str(error))}") from error
