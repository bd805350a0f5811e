"""One mission on disk: packets as received are the truth, and everything else can be made from them again.

Written by the service (packets, vetoes, requests) and by the worker (what it made of them). A packet is stored once,
and stays as it came. Its **turn** is its place in the order in which packets take effect: that of arrival, but within
a session that of their numbers. A packet has no turn while one before it is missing.
"""

import math
import sqlite3
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

from fcslam.cloud.settings import CloudConfig
from fcslam.errors import PacketConflictError, StoreError
from fcslam.records import Channel, Correction, Veto, frozen
from fcslam.storage.database import Database, check_file, told
from fcslam.wire.ledger import Ledger, Traffic
from fcslam.wire.messages import PacketKind
from fcslam.wire.packets import Label

APPLIED = "applied"
"""A fact: how many turns have taken effect."""
CONFIG = "config"
"""A fact: the mission's configuration."""

NEWS_M, NEWS_RAD, NEWS_QUALITY = 1e-3, 1e-5, 0.02
"""A correction that differs from the last one by less is none: 100 m from the origin of `odom` the first two are 1 mm.
Without a closure it is the same but for rounding, and each robot would be told so with every answer. Whether anybody
bears it out is always news."""

_VERSION = 2

_SCHEMA = """
CREATE TABLE packets (
    robot TEXT NOT NULL, epoch INTEGER NOT NULL, sequence INTEGER NOT NULL,
    received REAL NOT NULL, time REAL NOT NULL, kind TEXT, channel TEXT,
    refusal TEXT, turn INTEGER UNIQUE, data BLOB NOT NULL,
    PRIMARY KEY (robot, epoch, sequence)
) STRICT;
CREATE INDEX refusals ON packets (robot, epoch, sequence) WHERE refusal IS NOT NULL;
CREATE INDEX hellos ON packets (robot, epoch, sequence) WHERE kind = 'hello';
CREATE TABLE sessions (
    robot TEXT NOT NULL, epoch INTEGER NOT NULL, next INTEGER NOT NULL, PRIMARY KEY (robot, epoch)
) STRICT;
CREATE TABLE corrections (
    robot TEXT NOT NULL, epoch INTEGER NOT NULL, version INTEGER NOT NULL UNIQUE, time REAL NOT NULL,
    map_index INTEGER NOT NULL, x REAL NOT NULL, y REAL NOT NULL, theta REAL NOT NULL, quality REAL NOT NULL,
    PRIMARY KEY (robot, epoch)
) STRICT;
CREATE TABLE vetoes (
    number INTEGER PRIMARY KEY, robot_i TEXT NOT NULL, robot_j TEXT NOT NULL, stamp_i REAL, stamp_j REAL
) STRICT;
CREATE TABLE finalizations (
    number INTEGER PRIMARY KEY, turns INTEGER NOT NULL, vetoes INTEGER NOT NULL, run TEXT, failure TEXT
) STRICT;
CREATE TABLE facts (name TEXT PRIMARY KEY, value TEXT NOT NULL) STRICT
"""


@dataclass(frozen=True, slots=True)
class StoredPacket:
    """A packet as it came, and what its envelope says."""

    robot: str
    epoch: int
    sequence: int
    time: float
    kind: PacketKind | None
    """None: it could not be read, and was refused."""
    channel: Channel | None
    """Of a place."""
    data: bytes
    refusal: str | None = None
    """Why it does not count; its number is used up all the same."""


@dataclass(frozen=True, slots=True)
class Session:
    """How far a robot's session is."""

    robot: str
    epoch: int
    next: int
    """Number of the first packet that is missing."""


@dataclass(frozen=True, slots=True)
class SessionCorrection:
    """A session's correction; versions are the store's: they grow whatever is restarted."""

    robot: str
    epoch: int
    time: float
    """The largest stamp that the robot had seen when it sent what this rests on."""
    correction: Correction


@dataclass(frozen=True, slots=True)
class Finalization:
    """A request for the result of the first ``turns`` packets and ``vetoes`` vetoes."""

    number: int
    turns: int
    vetoes: int
    run: str | None
    """Name of the run folder, once it is there."""
    failure: str | None
    """Why there will be none."""


class MissionStore:
    """Every method is one transaction, durable when it returns. Any thread may call.

    Raises:
        StoreError: from every method: the disk is full or broken, and nothing has changed.
    """

    def __init__(self, path: Path) -> None:
        """Open a mission, or begin one where there is no file.

        Raises:
            StoreError: the file is no mission of this version, or cannot be used.
        """
        self._database = Database(path, _SCHEMA, _VERSION)

    def close(self) -> None:
        """Let go of the file."""
        self._database.close()

    def put(self, packets: Sequence[StoredPacket], received_s: float) -> int:
        """Store packets that are not there yet; returns how many are new.

        Raises:
            PacketConflictError: another packet has the number of one of them; those before it are stored.
        """
        new, conflict = self._database.share(lambda database: _put(database, packets, received_s))
        if conflict is not None:
            packet = packets[conflict]
            raise PacketConflictError(
                f"{packet.robot}: packet {packet.sequence} of epoch {packet.epoch} was stored before with "
                "other content; start the robot anew, in a new epoch",
                conflict,
            )
        return new

    def turns(self, after: int, limit: int) -> list[StoredPacket]:
        """Packets in the order of their turns, beginning with turn ``after`` (the first is 0), at most ``limit``."""
        columns = "robot, epoch, sequence, time, kind, channel, data, refusal"
        statement = f"SELECT {columns} FROM packets WHERE turn >= ? ORDER BY turn LIMIT ?"
        return [
            StoredPacket(
                robot, epoch, sequence, time, kind and PacketKind(kind), channel and Channel(channel), data, refusal
            )
            for robot, epoch, sequence, time, kind, channel, data, refusal in self._database.rows(
                statement, (after, limit)
            )
        ]

    def packet(self, robot: str, epoch: int, sequence: int) -> bytes:
        """A packet that is stored, as it came."""
        where = "robot = ? AND epoch = ? AND sequence = ?"
        data: bytes = self._database.value(f"SELECT data FROM packets WHERE {where}", (robot, epoch, sequence))
        return data

    def turn_count(self) -> int:
        """Packets that have a turn."""
        return int(self._database.value("SELECT ifnull(max(turn) + 1, 0) FROM packets"))

    def waiting_count(self, robot: str | None = None) -> int:
        """Packets of one robot or of all without a turn: one before them is missing."""
        statement = "SELECT count(*) FROM packets WHERE turn IS NULL AND (?1 IS NULL OR robot = ?1)"
        return int(self._database.value(statement, (robot,)))

    def refuse(self, turn: int, reason: str) -> None:
        """The packet of this turn does not fit what its robot sent before."""
        with self._database.transaction() as database:
            database.execute("UPDATE packets SET refusal = ? WHERE turn = ?", (reason, turn))

    def refusals(self, robot: str) -> list[tuple[int, int, str]]:
        """Epoch, number and reason of every refused packet of a robot."""
        columns, where = "epoch, sequence, refusal", "robot = ? AND refusal IS NOT NULL"
        return [
            (epoch, sequence, reason)
            for epoch, sequence, reason in self._database.rows(
                f"SELECT {columns} FROM packets WHERE {where} ORDER BY epoch, sequence", (robot,)
            )
        ]

    def refusal_count(self, robot: str) -> int:
        """How many packets of a robot were refused."""
        return int(
            self._database.value("SELECT count(*) FROM packets WHERE robot = ? AND refusal IS NOT NULL", (robot,))
        )

    def sessions(self, robot: str | None = None) -> list[Session]:
        """Sessions of one robot or of all, by robot and epoch."""
        statement = "SELECT robot, epoch, next FROM sessions WHERE ?1 IS NULL OR robot = ?1 ORDER BY robot, epoch"
        return [Session(*row) for row in self._database.rows(statement, (robot,))]

    def next_sequence(self, robot: str, epoch: int) -> int:
        """Number of the first packet of the session that is missing."""
        return next((session.next for session in self.sessions(robot) if session.epoch == epoch), 0)

    def newest_hello(self, robot: str, epoch: int) -> bytes | None:
        """What the session said last of its detectors."""
        where = "robot = ? AND epoch = ? AND kind = 'hello' AND refusal IS NULL"
        statement = f"SELECT data FROM packets WHERE {where} ORDER BY sequence DESC LIMIT 1"
        hello: bytes | None = self._database.value(statement, (robot, epoch))
        return hello

    def progress(self, turns: int, corrections: Sequence[SessionCorrection]) -> None:
        """So many turns have taken effect; corrections that are news get a new version."""
        with self._database.transaction() as database:
            _remember(database, APPLIED, str(turns))
            for correction in corrections:
                told = correction.correction
                row = (told.map_index, *told.T_map_odom.tolist(), told.quality)
                database.execute(
                    "INSERT INTO corrections SELECT ?1, ?2, ifnull(max(version) + 1, 0), ?3, ?4, ?5, ?6, ?7, ?8"
                    " FROM corrections WHERE true ON CONFLICT (robot, epoch) DO UPDATE SET version = excluded.version,"
                    " time = excluded.time, map_index = excluded.map_index, x = excluded.x, y = excluded.y,"
                    " theta = excluded.theta, quality = excluded.quality WHERE map_index != ?4"
                    f" OR max(abs(x - ?5), abs(y - ?6)) >= {NEWS_M}"
                    f" OR min(abs(theta - ?7), {2.0 * math.pi} - abs(theta - ?7)) >= {NEWS_RAD}"
                    f" OR abs(quality - ?8) >= {NEWS_QUALITY} OR (quality = 0) != (?8 = 0)",
                    (correction.robot, correction.epoch, correction.time, *row),
                )

    def applied(self) -> int:
        """Turns that have taken effect, whatever was restarted since."""
        return int(self.fact(APPLIED) or 0)

    def correction(self, robot: str, epoch: int) -> SessionCorrection | None:
        """The newest correction of a session."""
        columns = "time, version, map_index, quality, x, y, theta"
        statement = f"SELECT {columns} FROM corrections WHERE robot = ? AND epoch = ?"
        for time, version, map_index, quality, *pose in self._database.rows(statement, (robot, epoch)):
            return SessionCorrection(robot, epoch, time, Correction(robot, version, map_index, frozen(pose), quality))
        return None

    def veto(self, veto: Veto) -> None:
        """Keep a veto."""
        row = (veto.robot_i, veto.robot_j, *(veto.stamps or (None, None)))
        with self._database.transaction() as database:
            database.execute("INSERT INTO vetoes (robot_i, robot_j, stamp_i, stamp_j) VALUES (?, ?, ?, ?)", row)

    def vetoes(self) -> list[Veto]:
        """All vetoes, in their order."""
        rows = self._database.rows("SELECT robot_i, robot_j, stamp_i, stamp_j FROM vetoes ORDER BY number")
        return [Veto(i, j, None if stamp_i is None else (stamp_i, stamp_j)) for i, j, stamp_i, stamp_j in rows]

    def ask_to_finalize(self) -> int:
        """Ask for the result of all that has a turn now; returns the number of the request."""
        with self._database.transaction() as database:
            database.execute(
                "INSERT INTO finalizations (turns, vetoes)"
                " SELECT (SELECT ifnull(max(turn) + 1, 0) FROM packets), (SELECT count(*) FROM vetoes)"
            )
            return int(database.execute("SELECT last_insert_rowid()").fetchone()[0])

    def finalizations(self) -> list[Finalization]:
        """All requests, the oldest first."""
        columns = "number, turns, vetoes, run, failure"
        return [
            Finalization(*row) for row in self._database.rows(f"SELECT {columns} FROM finalizations ORDER BY number")
        ]

    def finalization(self, number: int) -> Finalization:
        """One request, which is there."""
        return next(asked for asked in self.finalizations() if asked.number == number)

    def answer(self, number: int, run: str | None, failure: str | None = None) -> None:
        """What came of a request."""
        with self._database.transaction() as database:
            database.execute("UPDATE finalizations SET run = ?, failure = ? WHERE number = ?", (run, failure, number))

    def fact(self, name: str) -> str | None:
        """Something else to be remembered of the mission; None if it never was."""
        value: str | None = self._database.value("SELECT value FROM facts WHERE name = ?", (name,))
        return value

    def remember(self, name: str, value: str) -> None:
        """Keep a fact, in the place of what it was before."""
        with self._database.transaction() as database:
            _remember(database, name, value)

    def traffic(self) -> Ledger:
        """Packets that count, and the bytes of those that were refused."""
        columns, groups = "robot, kind, channel, refusal IS NULL", "robot, kind, channel, refusal IS NULL"
        statement = f"SELECT {columns}, count(*), sum(length(data)) FROM packets GROUP BY {groups}"
        accepted: dict[Label, Traffic] = {}
        refused = Traffic()
        for robot, kind, channel, counts, packets, size in self._database.rows(statement):
            if counts:
                accepted[Label(robot, PacketKind(kind), channel and Channel(channel))] = Traffic(packets, size)
            else:
                refused += Traffic(packets, size)
        return Ledger(accepted, refused)

    def arrived(self, after: int, limit: int) -> list[tuple[int, str, PacketKind | None, Channel | None, Traffic]]:
        """What came in after a row of the file (0: all), at most ``limit`` packets.

        Last row, robot, kind, channel and traffic of each of its parts; refused packets count, too.
        """
        chosen = "SELECT rowid, robot, kind, channel, length(data) AS size FROM packets WHERE rowid > ? ORDER BY rowid"
        parts = "max(rowid), robot, kind, channel, count(*), sum(size)"
        statement = f"SELECT {parts} FROM ({chosen} LIMIT ?) GROUP BY robot, kind, channel"
        return [
            (row, robot, kind and PacketKind(kind), channel and Channel(channel), Traffic(count, size))
            for row, robot, kind, channel, count, size in self._database.rows(statement, (after, limit))
        ]

    def export(self, path: Path) -> None:
        """Write the mission as one new file.

        Raises:
            StoreError: there is a file already, or it cannot be written.
        """
        self._database.export(path)


def check_mission(path: Path) -> None:
    """Refuse a file that is no exported mission.

    Raises:
        StoreError: it is not what ``MissionStore.export`` writes.
    """
    check_file(path, _SCHEMA, _VERSION)
    with told(path), closing(sqlite3.connect(f"{path.resolve().as_uri()}?mode=ro&immutable=1", uri=True)) as found:
        labels = found.execute("SELECT DISTINCT kind, channel, refusal IS NULL FROM packets").fetchall()
        facts = dict(found.execute("SELECT name, value FROM facts").fetchall())
    try:
        for kind, channel, counts in labels:
            if counts or kind is not None:
                Label("", PacketKind(kind), None if channel is None else Channel(channel))
        CloudConfig.model_validate_json(facts.get(CONFIG, "{}"))
        int(facts.get(APPLIED, "0"))
    except ValueError as error:
        raise StoreError(f"{path}: {' '.join(str(error).split())}") from error


def _remember(database: sqlite3.Connection, name: str, value: str) -> None:
    database.execute("INSERT OR REPLACE INTO facts VALUES (?, ?)", (name, value))


def _put(database: sqlite3.Connection, packets: Sequence[StoredPacket], received_s: float) -> tuple[int, int | None]:
    """How many packets are new, and the index of the first that has another one's number: there it stops."""
    conflict, new = None, 0
    for index, packet in enumerate(packets):
        if _insert(database, packet, received_s):
            new += 1
        elif not _is_there(database, packet):
            conflict = index
            break
    for robot, epoch in dict.fromkeys((packet.robot, packet.epoch) for packet in packets):
        _give_turns(database, robot, epoch)
    return new, conflict


def _insert(database: sqlite3.Connection, packet: StoredPacket, received_s: float) -> bool:
    columns = "robot, epoch, sequence, received, time, kind, channel, refusal, data"
    number = (packet.robot, packet.epoch, packet.sequence)
    row = (*number, received_s, packet.time, packet.kind, packet.channel, packet.refusal, packet.data)
    statement = f"INSERT INTO packets ({columns}) VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?) ON CONFLICT DO NOTHING"
    return database.execute(statement, row).rowcount > 0


def _is_there(database: sqlite3.Connection, packet: StoredPacket) -> bool:
    statement = "SELECT data FROM packets WHERE robot = ? AND epoch = ? AND sequence = ?"
    (data,) = database.execute(statement, (packet.robot, packet.epoch, packet.sequence)).fetchone()
    return bool(data == packet.data)


def _give_turns(database: sqlite3.Connection, robot: str, epoch: int) -> None:
    """Packets of a session that miss nothing any more come next, in the order of their numbers."""
    session = (robot, epoch)
    row = database.execute("SELECT next FROM sessions WHERE robot = ? AND epoch = ?", session).fetchone()
    first = end = row[0] if row else 0
    turn = database.execute("SELECT ifnull(max(turn) + 1, 0) FROM packets").fetchone()[0]
    give = "UPDATE packets SET turn = ? WHERE robot = ? AND epoch = ? AND sequence = ?"
    while database.execute(give, (turn + end - first, *session, end)).rowcount:
        end += 1
    database.execute(
        "INSERT INTO sessions VALUES (?, ?, ?) ON CONFLICT (robot, epoch) DO UPDATE SET next = excluded.next",
        (*session, end),
    )
