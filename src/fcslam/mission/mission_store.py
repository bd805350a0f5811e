"""One mission on disk: packets as received are the truth, and everything else can be computed from them again.

The service writes packets, edits and requests; the worker writes results. A packet is stored once and never changes.
Packets are numbered by **arrival**. The order in which they take effect follows from it: ``cloud.packet_log``.
"""

import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np

from fcslam.cloud.edits import floors, in_force, stamps_of
from fcslam.cloud.replies import SessionCorrection, is_news
from fcslam.cloud.report import Track
from fcslam.cloud.sessions import robot_and_epoch, robot_of, session_name
from fcslam.cloud.settings import CloudConfig
from fcslam.config import one_line
from fcslam.errors import InputError, PacketConflictError, StoreError
from fcslam.geometry.groups import SE2, SE3, group_of
from fcslam.mission.edits import check_undo, edit_json, kind_of, read_edit, sessions_of
from fcslam.records import (
    Change,
    Channel,
    Constraint,
    Correction,
    Edit,
    FloatArray,
    Keyscan,
    ManualClosure,
    Removal,
    Undo,
    frozen,
)
from fcslam.storage.database import Database, check_file, translate_errors
from fcslam.storage.row_store import RowStore, StoreTable, Transaction, all_rows, change_rows
from fcslam.untrusted import check_unpacked, open_database, unpack
from fcslam.wire.ledger import Ledger, Traffic
from fcslam.wire.limits import MAXIMUM_BATCH_PACKETS
from fcslam.wire.messages import Hello, PacketKind
from fcslam.wire.packets import Label, decode

_Body = TypeVar("_Body", Hello, Keyscan, Constraint)
Refusal = tuple[str, int, int, str]
"""Robot, epoch and number of a packet, and why it has no effect."""

APPLIED = "applied"
"""A fact: how many packets took effect."""
WAITING = "waiting"
"""A fact: how many packets of each robot waited for their effect when ``APPLIED`` was noted."""
IN_SPACE = "T_map_odom "
"""Facts of missions in space begin so, before robot and epoch: all numbers of the pose of a correction."""
CONFIG = "config"
"""A fact: the mission's configuration."""
VERSION = 8
"""Version of the schema and of the packets."""
MOST_PACKETS = 2**53
"""No mission has as many."""
NEARBY_S = 1.0
"""An edit may name a moment this far outside of a session: stamps are rounded when they are printed."""
_AT_ONCE = 10_000
"""Packets that are read at once."""
_COLUMNS = "robot, epoch, sequence, time, kind, channel, data, refusal"

SCHEMA = """
CREATE TABLE packets (
    arrival INTEGER PRIMARY KEY,
    robot TEXT NOT NULL, epoch INTEGER NOT NULL, sequence INTEGER NOT NULL,
    received REAL NOT NULL, time REAL NOT NULL, kind TEXT, channel TEXT,
    refusal TEXT, data BLOB NOT NULL, seal BLOB NOT NULL,
    UNIQUE (robot, epoch, sequence)
) STRICT;
CREATE INDEX refusals ON packets (robot, epoch, sequence) WHERE refusal IS NOT NULL;
CREATE INDEX hellos ON packets (robot, epoch, sequence) WHERE kind = 'hello';
CREATE TABLE corrections (
    robot TEXT NOT NULL, epoch INTEGER NOT NULL, version INTEGER NOT NULL UNIQUE, time REAL NOT NULL,
    map_index INTEGER NOT NULL, x REAL NOT NULL, y REAL NOT NULL, theta REAL NOT NULL, quality REAL NOT NULL,
    seal BLOB NOT NULL,
    PRIMARY KEY (robot, epoch)
) STRICT;
CREATE TABLE edits (
    number INTEGER PRIMARY KEY, author TEXT NOT NULL, time REAL NOT NULL, kind TEXT NOT NULL, content TEXT NOT NULL,
    seal BLOB NOT NULL
) STRICT;
CREATE TABLE finalizations (
    number INTEGER PRIMARY KEY, arrivals INTEGER NOT NULL, edits INTEGER NOT NULL, run TEXT, failure TEXT,
    seal BLOB NOT NULL
) STRICT;
CREATE TABLE tracks (
    robot TEXT NOT NULL, epoch INTEGER NOT NULL, stamps BLOB NOT NULL, keyscans BLOB NOT NULL, offsets BLOB NOT NULL,
    seal BLOB NOT NULL,
    PRIMARY KEY (robot, epoch)
) STRICT;
CREATE TABLE facts (name TEXT PRIMARY KEY, value TEXT NOT NULL, seal BLOB NOT NULL) STRICT
"""
PACKETS = StoreTable(
    "packets",
    ("arrival",),
    ("arrival", "robot", "epoch", "sequence", "received", "time", "kind", "channel", "refusal", "data"),
)
CORRECTIONS = StoreTable(
    "corrections", ("robot", "epoch"), ("robot", "epoch", "version", "time", "map_index", "x", "y", "theta", "quality")
)
EDITS = StoreTable("edits", ("number",), ("number", "author", "time", "kind", "content"))
FINALIZATIONS = StoreTable("finalizations", ("number",), ("number", "arrivals", "edits", "run", "failure"))
TRACKS = StoreTable("tracks", ("robot", "epoch"), ("robot", "epoch", "stamps", "keyscans", "offsets"))
FACTS = StoreTable("facts", ("name",), ("name", "value"))
TABLES = PACKETS, CORRECTIONS, EDITS, FINALIZATIONS, TRACKS, FACTS
"""All that a mission is, in the order of ``SCHEMA``."""


@dataclass(frozen=True, slots=True)
class StoredPacket:
    """A packet as received, and the contents of its envelope."""

    robot: str
    epoch: int
    sequence: int
    time: float
    kind: PacketKind | None
    """None: it could not be read, and was refused."""
    channel: Channel | None
    """Channel of a place."""
    data: bytes
    refusal: str | None = None
    """Why it has no effect; its number is used up."""

    @property
    def order(self) -> tuple[float, str, int, int]:
        """Key of the canonical order, as ``Packet.order``."""
        return self.time, self.robot, self.epoch, self.sequence


class Envelope(NamedTuple):
    """Order of a packet."""

    robot: str
    epoch: int
    sequence: int
    time: float
    is_refused: bool


@dataclass(frozen=True, slots=True)
class Finalization:
    """A request for the result of the first ``arrivals`` packets and ``edits`` edits."""

    number: int
    arrivals: int
    edits: int
    run: str | None
    """Name of the run folder; None until it is written."""
    failure: str | None
    """Why it failed."""


class MissionStore:
    """Every method is one transaction, durable when it returns. Any thread may call.

    Raises:
        StoreError: from every method: the disk is full or broken, and nothing has changed.
    """

    def __init__(self, place: Path | RowStore, *, is_checked: bool = False) -> None:
        """Open a mission: that of a file, which is created if it is missing, or that of a server.

        ``is_checked``: ``check_mission`` passed the file just now.
        """
        self._database: RowStore = (
            Database(place, SCHEMA, VERSION, is_checked=is_checked) if isinstance(place, Path) else place
        )
        self._edits: list[Edit] = []
        """The edits read so far, numbered from 1; each request of a robot asks for them."""

    def close(self) -> None:
        """Close the file."""
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
                f"{session_name(packet.robot, packet.epoch)}: packet {packet.sequence} was stored before with other "
                "content; restart the robot in a new session",
                conflict,
            )
        return new

    def arrivals(self, after: int, limit: int) -> list[tuple[int, StoredPacket]]:
        """At most ``limit`` packets with their arrival, in its order; the first arrival is 1."""
        statement = f"SELECT arrival, {_COLUMNS} FROM packets WHERE arrival > ? ORDER BY arrival LIMIT ?"
        return [(arrival, _packet(*row)) for arrival, *row in self._database.rows(statement, (after, limit))]

    def contents(self, until: int) -> Iterator[bytes]:
        """The packets that arrived first until arrival ``until``, encoded, in that order."""
        statement = "SELECT data FROM packets WHERE arrival > ? AND arrival <= ? ORDER BY arrival"
        for after in range(0, until, _AT_ONCE):
            for (data,) in self._database.rows(statement, (after, min(after + _AT_ONCE, until))):
                yield data

    def packets(self, numbers: Sequence[tuple[str, int, int]]) -> dict[tuple[str, int, int], StoredPacket]:
        """Those of some packets that are stored, by robot, epoch and sequence number."""
        return _found(self._database.rows, numbers)

    def envelopes(self, until: int = MOST_PACKETS, after: int = 0) -> list[Envelope]:
        """The envelopes of the packets after arrival ``after`` until arrival ``until``, in that order."""
        statement = (
            "SELECT robot, epoch, sequence, time, refusal IS NOT NULL FROM packets"
            " WHERE arrival > ? AND arrival <= ? ORDER BY arrival"
        )
        return [
            Envelope(robot, epoch, sequence, time, bool(refused))
            for robot, epoch, sequence, time, refused in self._database.rows(statement, (after, until))
        ]

    def refuse(self, refusals: Iterable[Refusal]) -> None:
        """Note packets that do not fit what their robots sent before."""
        with self._database.transaction() as database:
            _refuse(database, refusals)

    def refusals(self, robot: str, limit: int = 100) -> list[tuple[int, int, str]]:
        """Epoch, number and reason of the last refused packets of a robot, at most ``limit``."""
        columns, where = "epoch, sequence, refusal", "robot = ? AND refusal IS NOT NULL"
        newest = f"SELECT {columns} FROM packets WHERE {where} ORDER BY epoch DESC, sequence DESC LIMIT ?"
        return [
            (epoch, number, reason) for epoch, number, reason in reversed(self._database.rows(newest, (robot, limit)))
        ]

    def refused(self, robot: str) -> Traffic:
        """How many packets of a robot were refused, and their bytes."""
        statement = (
            "SELECT count(*), coalesce(sum(length(data)), 0) FROM packets WHERE robot = ? AND refusal IS NOT NULL"
        )
        ((count, size),) = self._database.rows(statement, (robot,))
        return Traffic(count, int(size))

    def newest_hello(self, robot: str, epoch: int) -> Hello | None:
        """The session's newest hello."""
        where = "robot = ? AND epoch = ? AND kind = 'hello' AND refusal IS NULL"
        return next(iter(self._bodies(Hello, f"{where} ORDER BY sequence DESC LIMIT 1", robot, epoch)), None)

    def newest_keyscan(self, robot: str, epoch: int) -> Keyscan | None:
        """The session's newest keyscan."""
        where = "robot = ? AND epoch = ? AND kind = ? AND refusal IS NULL ORDER BY sequence DESC LIMIT 1"
        return next(iter(self._bodies(Keyscan, where, robot, epoch, PacketKind.KEYSCAN)), None)

    def keyscans_near(self, robot: str, epoch: int, time: float, limit: int) -> list[Keyscan]:
        """At most ``limit`` keyscans of a session that it sent nearest to a time."""
        where = "robot = ? AND epoch = ? AND kind = ? AND refusal IS NULL AND sequence"
        values = robot, epoch, PacketKind.KEYSCAN, self._last_before(robot, epoch, time), limit
        before = self._bodies(Keyscan, f"{where} <= ? ORDER BY sequence DESC LIMIT ?", *values)
        since = self._bodies(Keyscan, f"{where} > ? ORDER BY sequence LIMIT ?", *values)
        return sorted(before + since, key=lambda keyscan: abs(keyscan.stamp - time))[:limit]

    def constraints_since(self, robot: str, epoch: int, time: float) -> list[Constraint]:
        """Constraints of a session that it sent at this time or later, in their order."""
        where = "robot = ? AND epoch = ? AND kind = ? AND sequence > ? AND refusal IS NULL ORDER BY sequence"
        last = self._last_before(robot, epoch, time)
        return self._bodies(Constraint, where, robot, epoch, PacketKind.CONSTRAINT, last)

    def _last_before(self, robot: str, epoch: int, time: float) -> int:
        """Number of the last packet of a session before a time, or -1, from the newest on: their times only grow."""
        statement = "robot = ? AND epoch = ? AND time < ? ORDER BY sequence DESC LIMIT 1"
        last = self._database.value(f"SELECT sequence FROM packets WHERE {statement}", (robot, epoch, time))
        return -1 if last is None else int(last)

    def _bodies(self, kind: type[_Body], where: str, *values: Any) -> list[_Body]:
        rows = self._database.rows(f"SELECT data FROM packets WHERE {where}", values)
        return [body for (data,) in rows if isinstance(body := decode(data).body, kind)]

    def progress(
        self,
        applied: int,
        corrections: Sequence[SessionCorrection],
        waiting: Mapping[str, int] | None = None,
        refusals: Iterable[Refusal] = (),
    ) -> None:
        """Note how many packets took effect, how many of which robot wait for that, and which do not fit what their
        robots sent before; corrections that are news get a new version.
        """
        with self._database.transaction() as database:
            _remember(database, APPLIED, str(applied))
            _remember(database, WAITING, " ".join(f"{robot} {count}" for robot, count in (waiting or {}).items()))
            _refuse(database, refusals)
            for correction in corrections:
                known = _read_correction(database.execute, correction.robot, correction.epoch)
                if is_news(None if known is None else known.correction, correction.correction):
                    _write_correction(database, correction)

    def received_s(self, count: int) -> float:
        """When the oldest of the ``count`` newest packets arrived, seconds since 1970."""
        newest = "SELECT received FROM packets ORDER BY arrival DESC LIMIT 1 OFFSET ?"
        return float(self._database.rows(newest, (count - 1,))[0][0])

    def applied(self) -> int:
        """How many packets took effect, before restarts too."""
        return self.backlog()[0]

    def backlog(self) -> tuple[int, dict[str, int]]:
        """How many packets took effect, and how many of each robot waited for that at the same time."""
        return _backlog(
            dict(self._database.rows("SELECT name, value FROM facts WHERE name IN (?, ?)", (APPLIED, WAITING)))
        )

    def correction(self, robot: str, epoch: int) -> SessionCorrection | None:
        """The newest correction of a session."""
        return _read_correction(self._database.rows, robot, epoch)

    def edit(self, content: Change | Undo, author: str, time_s: float) -> Edit:
        """Append an edit to the log."""
        with self._database.transaction() as database:
            if isinstance(content, Undo):
                check_undo(_edits(database.execute, 0), content.number)
            number = _next(database, "edits", "number")
            database.insert(EDITS, [(number, author, float(time_s), kind_of(content), edit_json(content))])
        return Edit(number, author, time_s, content)

    def check_named(self, content: Change | Undo) -> None:
        """Check that the sessions and moments that an edit names are in the mission, both of a closure on one floor."""
        spans = {
            session_name(robot, epoch): (first, last)
            for robot, epoch, first, last in self._database.rows(
                "SELECT robot, epoch, min(time), max(time) FROM packets WHERE refusal IS NULL GROUP BY robot, epoch"
            )
        }
        named, known = sessions_of(content), set(spans)
        match content:
            case Removal(epoch=None):
                known = {robot_of(name) for name in spans}
            case Removal(epoch=int(epoch)):
                named = (session_name(content.robot, epoch),)
        for name in named:
            if name not in known:
                raise InputError(f"there is no session '{name}'; there are {', '.join(sorted(known))}")
        for name, stamp in stamps_of(content):
            first, last = spans[name]
            if not first - NEARBY_S <= stamp <= last + NEARBY_S:
                raise InputError(f"{name} has no scan at {stamp:.3f} s; its scans are from {first:.3f} to {last:.3f} s")
        if isinstance(content, ManualClosure):
            given = floors(in_force(self.edits()))
            if len({given.get(name, self._floor(name)) for name in named}) > 1:
                raise InputError(f"{' and '.join(named)} are on different floors, which no closure joins")

    def _floor(self, session: str) -> str:
        hello = self.newest_hello(*robot_and_epoch(session))
        return "" if hello is None else hello.floor

    def edits(self, after: int = 0) -> list[Edit]:
        """The edits after number ``after``, in their order."""
        known = self._edits
        newer = _edits(self._database.rows, len(known))
        if newer:
            known = [*known, *newer]
            if known[-1].number == len(known):  # none is missing, as where another instance is about to add one
                self._edits = known
        return [edit for edit in known if edit.number > after]

    def ask_to_finalize(self) -> int:
        """Request the result of all packets that arrived; returns the number of the request."""
        with self._database.transaction() as database:
            number = _next(database, "finalizations", "number")
            arrivals, edits = _next(database, "packets", "arrival") - 1, _next(database, "edits", "number") - 1
            database.insert(FINALIZATIONS, [(number, arrivals, edits, None, None)])
            return number

    def finalizations(self) -> list[Finalization]:
        """All requests, the oldest first."""
        return [Finalization(*row) for row in self._database.rows(all_rows(FINALIZATIONS))]

    def finalization(self, number: int) -> Finalization:
        """One request, which exists."""
        statement = f"SELECT {', '.join(FINALIZATIONS.columns)} FROM finalizations WHERE number = ?"
        return Finalization(*self._database.rows(statement, (number,))[0])

    def answer(self, number: int, run: str | None, failure: str | None = None) -> None:
        """Store the outcome of a request."""
        with self._database.transaction() as database:
            change_rows(database, FINALIZATIONS, {"run": run, "failure": failure}, "number = ?", (number,))

    def fact(self, name: str) -> str | None:
        """A stored fact about the mission; None if the mission does not have it."""
        value: str | None = self._database.value("SELECT value FROM facts WHERE name = ?", (name,))
        return value

    def configure(self, config: CloudConfig) -> CloudConfig:
        """Store the mission's configuration, if it has none yet; returns the one that it has."""
        if self.fact(CONFIG) is None:  # else nothing is written: who only reads a mission changes nothing
            with self._database.transaction() as database:
                if not database.execute("SELECT 1 FROM facts WHERE name = ?", (CONFIG,)).fetchall():
                    _remember(database, CONFIG, config.model_dump_json())
        return CloudConfig.model_validate_json(self.fact(CONFIG) or "")

    def put_track(self, robot: str, epoch: int, track: Track) -> None:
        """Store the scans of a session, which a robot keeps to itself; known to the robot's own machine only."""
        arrays = track.stamps.astype("<f8"), track.keyscans.astype("<i8"), track.T_keyscan_base.astype("<f8")
        row = (robot, epoch, *(zlib.compress(array.tobytes()) for array in arrays))
        with self._database.transaction() as database:
            database.insert(TRACKS, [row])

    def tracks(self) -> dict[tuple[str, int], Track]:
        """The scans of every session whose scans are known, by robot and epoch."""
        rows = self._database.rows("SELECT robot, epoch, stamps, keyscans, offsets FROM tracks", ())
        packed = unpacked = 0
        tracks: dict[tuple[str, int], Track] = {}
        for robot, epoch, *blobs in rows:
            try:
                columns = [unpack(blob, "zlib") for blob in blobs]
                packed, unpacked = packed + sum(map(len, blobs)), unpacked + sum(map(len, columns))
                check_unpacked(packed, unpacked)
                tracks[robot, epoch] = _track(*columns)
            except (OSError, ValueError) as error:
                raise StoreError(f"the scans of {session_name(robot, epoch)} are broken ({error})") from error
        return tracks

    def traffic(self) -> Ledger:
        """Traffic of accepted packets."""
        groups = "robot, kind, channel"
        statement = (
            f"SELECT {groups}, count(*), CAST(sum(length(data)) AS BIGINT) FROM packets"
            f" WHERE refusal IS NULL GROUP BY {groups} ORDER BY {groups}"
        )
        return Ledger(
            {
                Label(robot, PacketKind(kind), channel and Channel(channel)): Traffic(packets, size)
                for robot, kind, channel, packets, size in self._database.rows(statement)
            }
        )

    def traffic_since(
        self, after: int, limit: int
    ) -> list[tuple[int, str, PacketKind | None, Channel | None, Traffic]]:
        """The traffic of at most ``limit`` packets after an arrival, refused ones included.

        Last arrival, robot, kind, channel and traffic of each group.
        """
        chosen = (
            "SELECT arrival, robot, kind, channel, length(data) AS size FROM packets"
            " WHERE arrival > ? ORDER BY arrival LIMIT ?"
        )
        groups = "robot, kind, channel"
        statement = (
            f"SELECT max(arrival), {groups}, count(*), CAST(sum(size) AS BIGINT) FROM ({chosen}) AS chosen"
            f" GROUP BY {groups} ORDER BY {groups}"
        )
        return [
            (arrival, robot, kind and PacketKind(kind), channel and Channel(channel), Traffic(count, size))
            for arrival, robot, kind, channel, count, size in self._database.rows(statement, (after, limit))
        ]

    def export(self, path: Path) -> None:
        """Write the mission as one new file."""
        self._database.export(path)


def check_mission(path: Path) -> None:
    """Refuse a file that is not an exported mission."""
    check_file(path, SCHEMA, VERSION)
    with translate_errors(path), closing(open_database(path)) as opened:
        labels = opened.execute("SELECT DISTINCT kind, channel, refusal IS NULL FROM packets").fetchall()
        facts = dict(opened.execute("SELECT name, value FROM facts").fetchall())
        edits = opened.execute("SELECT number, author, time, kind, content FROM edits ORDER BY number").fetchall()
    try:
        _check_edits(edits)
        for kind, channel, counts in labels:
            if counts or kind is not None:
                Label("", PacketKind(kind), None if channel is None else Channel(channel))
        CloudConfig.model_validate_json(facts.get(CONFIG, "{}"))
        _backlog(facts)
        if not all(len(_numbers(value)) == SE3.size for name, value in facts.items() if name.startswith(IN_SPACE)):
            raise InputError("a correction in space is not a pose")
    except (ValueError, InputError) as error:
        raise StoreError(f"{path}: {one_line(str(error))}") from error


def _edits(query: Callable[[str, tuple[int]], Iterable[Any]], after: int) -> list[Edit]:
    rows = query("SELECT number, author, time, kind, content FROM edits WHERE number > ? ORDER BY number", (after,))
    return [Edit(number, author, time_s, read_edit(*content)) for number, author, time_s, *content in rows]


def _check_edits(rows: Sequence[tuple[int, str, float, str, str]]) -> None:
    edits: list[Edit] = []
    for number, author, time_s, kind, content in rows:
        edit = Edit(number, author, time_s, read_edit(kind, content))
        if number != len(edits) + 1:
            raise InputError(f"edit {len(edits) + 1} is missing")
        if isinstance(edit.content, Undo):
            check_undo(edits, edit.content.number)
        edits.append(edit)


def _backlog(facts: Mapping[str, str]) -> tuple[int, dict[str, int]]:
    words = facts.get(WAITING, "").split()
    return int(facts.get(APPLIED, "0")), dict(zip(words[::2], map(int, words[1::2]), strict=True))


def _refuse(database: Transaction, refusals: Iterable[Refusal]) -> None:
    for *number, reason in refusals:
        change_rows(database, PACKETS, {"refusal": reason}, "robot = ? AND epoch = ? AND sequence = ?", number)


def _remember(database: Transaction, name: str, value: str) -> None:
    database.insert(FACTS, [(name, value)], replaces=True)


def _next(database: Transaction, table: str, column: str) -> int:
    return int(database.execute(f"SELECT coalesce(max({column}), 0) + 1 FROM {table}").fetchone()[0])


def _put(database: Transaction, packets: Sequence[StoredPacket], received_s: float) -> tuple[int, int | None]:
    """How many packets are new, and the index of the first conflicting packet, where it stops."""
    numbers = [(packet.robot, packet.epoch, packet.sequence) for packet in packets]
    known = {number: bytes(packet.data) for number, packet in _found(database.execute, numbers).items()}
    first = _next(database, "packets", "arrival")
    conflict: int | None = None
    rows: list[tuple[object, ...]] = []
    for index, (number, packet) in enumerate(zip(numbers, packets, strict=True)):
        if number not in known:
            known[number] = packet.data
            times, label = (float(received_s), float(packet.time)), (packet.kind, packet.channel)
            rows.append((first + len(rows), *number, *times, *label, packet.refusal, packet.data))
        elif known[number] != packet.data:
            conflict = index
            break
    database.insert(PACKETS, rows)
    return len(rows), conflict


def _found(
    query: Callable[[str, Sequence[object]], Iterable[Any]], numbers: Sequence[tuple[str, int, int]]
) -> dict[tuple[str, int, int], StoredPacket]:
    found: dict[tuple[str, int, int], StoredPacket] = {}
    for begin in range(0, len(numbers), MAXIMUM_BATCH_PACKETS):
        asked = numbers[begin : begin + MAXIMUM_BATCH_PACKETS]
        marks = ", ".join("(?, ?, ?)" for _ in asked)
        # A join, because SQLite uses no index for "(...) IN (VALUES ...)" and would read all packets.
        statement = (
            f"WITH asked (robot, epoch, sequence) AS (VALUES {marks})"
            f" SELECT {_COLUMNS} FROM asked JOIN packets USING (robot, epoch, sequence)"
        )
        for row in query(statement, [value for number in asked for value in number]):
            packet = _packet(*row)
            found[packet.robot, packet.epoch, packet.sequence] = packet
    return found


def _track(stamps: bytes, keyscans: bytes, offsets: bytes) -> Track:
    size = SE3.size if len(offsets) == SE3.size * len(stamps) > 0 else SE2.size
    track = Track(
        frozen(np.frombuffer(stamps, "<f8")),
        np.frombuffer(keyscans, "<i8"),
        frozen(np.frombuffer(offsets, "<f8").reshape(-1, size)),
    )
    if not len(track.stamps) == len(track.keyscans) == len(track.T_keyscan_base):
        raise ValueError("its columns have different lengths")
    if not (np.isfinite(track.stamps).all() and np.isfinite(track.T_keyscan_base).all()):
        raise ValueError("a number is not finite")
    if len(track.keyscans) and (track.keyscans.min() < 0):
        raise ValueError("a keyscan has a negative number")
    if size == SE3.size and not np.allclose(np.linalg.norm(track.T_keyscan_base[:, 3:], axis=1), 1.0):
        raise ValueError("a quaternion is not one")
    return track


def _packet(
    robot: str,
    epoch: int,
    sequence: int,
    time: float,
    kind: str | None,
    channel: str | None,
    data: bytes,
    refusal: str | None,
) -> StoredPacket:
    read = PacketKind(kind) if kind else None, Channel(channel) if channel else None
    return StoredPacket(robot, epoch, sequence, time, *read, data, refusal)


def _read_correction(
    query: Callable[[str, tuple[str, int]], Iterable[Any]], robot: str, epoch: int
) -> SessionCorrection | None:
    columns = "time, version, map_index, quality, value, x, y, theta"
    statement = (
        f"SELECT {columns} FROM corrections LEFT JOIN facts ON name = '{IN_SPACE}' || robot || ' ' || epoch"
        " WHERE robot = ? AND epoch = ?"
    )
    for time, version, map_index, quality, in_space, *planar in query(statement, (robot, epoch)):
        pose: FloatArray = frozen(planar if in_space is None else _numbers(in_space))
        return SessionCorrection(robot, epoch, time, Correction(robot, version, map_index, pose, quality))
    return None


def _numbers(text: str) -> list[float]:
    return [float(number) for number in text.split()]


def _write_correction(database: Transaction, news: SessionCorrection) -> None:
    """Replace the session's correction; its version is the mission's next one."""
    correction = news.correction
    (version,) = database.execute("SELECT coalesce(max(version) + 1, 0) FROM corrections").fetchone()
    pose, quality = correction.T_map_odom, float(correction.quality)
    if group_of(pose) is SE3:
        _remember(database, f"{IN_SPACE}{news.robot} {news.epoch}", " ".join(map(repr, pose.tolist())))
    planar = group_of(pose).to_plane(pose).tolist()
    row = (news.robot, news.epoch, version, float(news.time), correction.map_index, *planar, quality)
    database.insert(CORRECTIONS, [row], replaces=True)
