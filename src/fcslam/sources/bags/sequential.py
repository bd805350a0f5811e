"""Reads the records of a bag from its beginning, for a bag whose index is missing, damaged or wrong.

It ends at the first damage or where the file is cut off. A chunk that is cut off is read as far as it can be unpacked.
The messages of one chunk are put in the order of their times, as an index does.
"""

import struct
from binascii import crc32
from collections import Counter
from collections.abc import Collection, Iterator
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO, NamedTuple

from fcslam.sources.bags.mcap_records import CHUNK, DATA_END, HEADER, MCAP_MAGIC
from fcslam.untrusted import MOST_CHUNKS_RATIO, check_unpacked, open_file, unpack

if TYPE_CHECKING:
    from rosbags.interfaces import Connection

LARGEST_CHUNK_BYTES = 256_000_000
"""Of a chunk without compression, which is read as one; recorders write some megabytes."""
_SCHEMA, _CHANNEL, _MESSAGE = 0x03, 0x04, 0x05
_ROS1_MESSAGE, _ROS1_CHUNK, _ROS1_CONNECTION = b"\x02", b"\x05", b"\x07"
_ROS1_MAGIC_BYTES = len(b"#ROSBAG V2.0\n")
_SECOND_NS = 10**9


class _Record(NamedTuple):
    """A connection, if it has no payload, or a message."""

    connection: int
    time_ns: int = 0
    payload: bytes | None = None


class _DamageError(ValueError):
    """The records end here."""


_ENDS = ValueError, KeyError, struct.error
"""Raised where a record has no such field, or is shorter than its fields."""


class SequentialReader:
    """A bag in one file, in the manner of the readers of rosbags."""

    def __init__(self, path: Path, ros1: bool) -> None:
        self._path = path
        self._ros1 = ros1
        self._known: dict[int, Connection] = {}
        self.connections: list[Connection] = []
        self.damage_bytes: int | None = None
        """Where in the file the reading ended; None if it was at the end."""
        self.size_bytes = path.stat().st_size
        self._unpacked = 0

    def open(self) -> None:
        """Find and count all messages."""
        counts = Counter(record.connection for record in self._records())
        self.connections = [each._replace(msgcount=counts[key]) for key, each in self._known.items()]

    def close(self) -> None:
        """Nothing stays open between two passes."""

    def messages(self, connections: "Collection[Connection]") -> "Iterator[tuple[Connection, int, bytes]]":
        """The messages of ``connections`` in the order of the file."""
        chosen = {each.id: each for each in connections}
        for record in self._records():
            if record.connection in chosen:
                yield chosen[record.connection], record.time_ns, record.payload or b""

    def _records(self) -> Iterator[_Record]:
        """All messages; ``damage_bytes`` says afterwards where they ended."""
        self.damage_bytes, self._unpacked = None, 0
        records = self._ros1_records if self._ros1 else self._mcap_records
        with open_file(self._path) as file:
            file.seek(_ROS1_MAGIC_BYTES if self._ros1 else len(MCAP_MAGIC))
            try:
                yield from records(file)
            except _ENDS:
                self.damage_bytes = file.tell()

    def _mcap_records(self, file: BinaryIO, schemas: dict[int, str] | None = None) -> Iterator[_Record]:
        """``schemas`` are those that were seen before; None outside of a chunk."""
        inside = schemas is not None
        schemas = {} if schemas is None else schemas
        while head := file.read(9):
            opcode, size = struct.unpack("<BQ", head)  # struct.error if it is cut off
            if opcode == DATA_END:
                return
            if opcode == 0 or size > LARGEST_CHUNK_BYTES:
                raise _DamageError
            content = file.read(size)
            is_cut = len(content) < size
            if opcode == CHUNK and not inside:
                records, is_whole = _mcap_chunk(content, is_cut)
                self._count(len(records))
                yield from _in_time(self._mcap_records(BytesIO(records), schemas), is_whole)
            if is_cut:
                raise _DamageError
            if opcode == _SCHEMA:
                schemas[int.from_bytes(content[:2], "little")] = _text(content, 2)[0]
            elif opcode == _CHANNEL:
                self._add_channel(content, schemas)
            elif opcode == _MESSAGE:
                connection, _, time_ns, _ = struct.unpack_from("<HIQQ", content)
                yield _Record(connection, time_ns, content[22:])
            elif opcode == HEADER:
                schemas.clear()
        if not inside:
            raise _DamageError  # there is no end of the data

    def _count(self, unpacked: int) -> None:
        self._unpacked += unpacked
        check_unpacked(self.size_bytes, self._unpacked, MOST_CHUNKS_RATIO)

    def _add_channel(self, content: bytes, schemas: dict[int, str]) -> None:
        from rosbags.interfaces import ConnectionExtRosbag2

        key, schema = struct.unpack_from("<HH", content)
        topic, at = _text(content, 4)
        encoding, _ = _text(content, at)
        self._add(key, topic, schemas.get(schema, ""), ConnectionExtRosbag2(encoding, []))

    def _ros1_records(self, file: BinaryIO, inside: bool = False) -> Iterator[_Record]:
        from rosbags.interfaces import ConnectionExtRosbag1

        while head := file.read(4):
            fields = _ros1_fields(_exactly(file, int.from_bytes(head, "little")))
            kind = fields.get(b"op")
            size = int.from_bytes(_exactly(file, 4), "little")
            if kind is None or size > LARGEST_CHUNK_BYTES:
                raise _DamageError
            content = file.read(size)
            if kind == _ROS1_CHUNK and not inside:
                records, is_whole = _ros1_chunk(fields, content)
                self._count(len(records))
                yield from _in_time(self._ros1_records(BytesIO(records), inside=True), is_whole)
            if len(content) < size:
                raise _DamageError
            if kind == _ROS1_CONNECTION:
                stated = {**_ros1_fields(content), **fields}
                topic, kind_of = (stated[key].decode(errors="replace") for key in (b"topic", b"type"))
                key = int.from_bytes(stated[b"conn"], "little")
                self._add(key, topic, kind_of.replace("/", "/msg/"), ConnectionExtRosbag1(None, None))
            elif kind == _ROS1_MESSAGE:
                seconds, nanoseconds = struct.unpack("<II", fields[b"time"])
                connection = int.from_bytes(fields[b"conn"], "little")
                yield _Record(connection, seconds * _SECOND_NS + nanoseconds, content)

    def _add(self, key: int, topic: str, kind: str, ext: Any) -> None:
        from rosbags.interfaces import Connection, MessageDefinition, MessageDefinitionFormat

        definition = MessageDefinition(MessageDefinitionFormat.NONE, "")
        self._known.setdefault(key, Connection(key, topic, kind, definition, "", 0, ext, self))


def _in_time(records: Iterator[_Record], is_whole: bool) -> Iterator[_Record]:
    """The records of a chunk by their times; raises where they end in damage."""
    found, damage = list[_Record](), None if is_whole else _DamageError()
    try:
        found.extend(records)
    except _ENDS as error:
        damage = _DamageError(error)
    yield from sorted(found, key=lambda record: record.time_ns)
    if damage is not None:
        raise damage


def _mcap_chunk(content: bytes, is_cut: bool) -> tuple[bytes, bool]:
    """The records of a chunk, as many as there are, and whether these are all."""
    size, crc = struct.unpack_from("<QI", content, 16)
    compression, at = _text(content, 28)
    if size > LARGEST_CHUNK_BYTES:
        raise _DamageError
    packed_bytes = int.from_bytes(content[at : at + 8], "little")
    records = unpack(content[at + 8 : at + 8 + packed_bytes], compression, size)
    if not is_cut and crc and len(records) == size and crc32(records) != crc:
        raise _DamageError
    return records, len(records) == size


def _ros1_chunk(fields: dict[bytes, bytes], content: bytes) -> tuple[bytes, bool]:
    size = int.from_bytes(fields[b"size"], "little")
    if size > LARGEST_CHUNK_BYTES:
        raise _DamageError
    records = unpack(content, fields[b"compression"].decode(errors="replace"), size)
    return records, len(records) == size


def _ros1_fields(content: bytes) -> dict[bytes, bytes]:
    """The fields of a record's header."""
    fields, at = dict[bytes, bytes](), 0
    while at < len(content):
        end = at + 4 + int.from_bytes(content[at : at + 4], "little")
        name, equals, value = content[at + 4 : end].partition(b"=")
        if not equals or end > len(content):
            raise _DamageError
        fields[name], at = value, end
    return fields


def _exactly(file: BinaryIO, size: int) -> bytes:
    content = file.read(size) if size <= LARGEST_CHUNK_BYTES else b""
    if len(content) < size:
        raise _DamageError
    return content


def _text(content: bytes, at: int) -> tuple[str, int]:
    """A string of MCAP, and where it ends."""
    start = at + 4
    end = start + int.from_bytes(content[at:start], "little")
    if end > len(content):
        raise _DamageError
    return content[start:end].decode(errors="replace"), end
