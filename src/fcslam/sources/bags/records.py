"""Reads the messages of one file of a bag: ROS 1, MCAP, or SQLite.

A file is read from its beginning, to its end or to the first damage. A chunk that is cut off is read as far as it can
be unpacked. Indexes and message definitions in the file are not used: one that is missing or wrong does no harm, and
the few types that are read have never changed.
"""

import struct
from binascii import crc32
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from io import BytesIO
from pathlib import Path
from typing import BinaryIO, NamedTuple

from fcslam.sources.bags.codec import NANOSECONDS
from fcslam.untrusted import MOST_STREAM_RATIO, check_unpacked, open_database, open_file, unpack

ROS1_MAGIC, MCAP_MAGIC, SQLITE_MAGIC = b"#ROSBAG V", b"\x89MCAP0\r\n", b"SQLite format 3\x00"
LARGEST_CHUNK_BYTES = 256_000_000
"""Largest decompressed chunk, which is read as one; recorders write some megabytes."""
_KEPT_BYTES = 8_000_000
"""Unpacked chunks that are kept while messages of several chunks are read in turn."""
_REREAD_RATIO = 10 * MOST_STREAM_RATIO
"""Bytes of a file to which messages in an odd order may unpack chunks again and again, as a multiple of its size."""
_HEADER, _SCHEMA, _CHANNEL, _MESSAGE, _CHUNK, _DATA_END = b"\x01", b"\x03", b"\x04", b"\x05", b"\x06", b"\x0f"
_ROS1_MESSAGE, _ROS1_CHUNK, _ROS1_CONNECTION = b"\x02", b"\x05", b"\x07"
_ROS1_MAGIC_BYTES = len(b"#ROSBAG V2.0\n")
_SQLITE_HEADER_BYTES = 100
OTHER_ENCODING = " as "
"""In the types of topics whose messages are not read, before their encoding."""


MessagePlace = tuple[int, int, int]
"""Where a message lies in its file: number of its chunk (-1: in none); bytes from the beginning of the chunk or the
file, or in a database the number of the row; and size in bytes."""


class StoredMessage(NamedTuple):
    """One message, not decoded."""

    topic: str
    kind: str
    """Type, without ``msg/``, as ROS 1 writes it."""
    time_ns: int
    payload: bytes
    place: MessagePlace


class DamageError(ValueError):
    """The records of a file end here; the message may say why."""


_ENDS = ValueError, KeyError, struct.error
"""Raised where a record has no such field, or is shorter than its fields."""


class RecordFile:
    """A bag of ROS 1, or an MCAP file."""

    def __init__(self, path: Path, ros1: bool) -> None:
        self.path = path
        self.ros1 = ros1
        """Whether messages are encoded as in ROS 1; of an MCAP file known after the first of them."""
        self.damage = ""
        """Where and why the reading ended before the end of the file; empty if it did not."""
        self._is_mcap = not ros1
        self._size = path.stat().st_size
        self._chunks: list[tuple[int, int, str, int]] = []
        """Start, packed bytes, compression and size of each."""
        self._unpacked = 0
        self.topics: dict[int, tuple[str, str]] = {}
        """Names and types by the numbers in the file, once it was read; some may have no message."""
        self._schemas: dict[int, str] = {}

    def messages(self) -> Iterator[StoredMessage]:
        """All messages in the order of the file, to the first damage."""
        self.damage, self._chunks, self._unpacked = "", [], 0
        with open_file(self.path) as file:
            file.seek(len(MCAP_MAGIC) if self._is_mcap else _ROS1_MAGIC_BYTES)
            try:
                yield from self._records(file)
            except _ENDS as error:
                reason = f" ({error})" if isinstance(error, DamageError) and str(error) else ""
                self.damage = f"{file.tell() / 1e6:.3f} of {self._size / 1e6:.3f} MB{reason}"

    @contextmanager
    def reading(self) -> Iterator[Callable[[MessagePlace], bytes]]:
        """A function that reads the message at a place again."""
        with open_file(self.path) as file:
            kept: dict[int, bytes] = {}
            unpacked = 0

            def payload(place: MessagePlace) -> bytes:
                nonlocal unpacked
                chunk, offset, size = place
                if chunk < 0:
                    file.seek(offset)
                    return file.read(size)
                if chunk not in kept:
                    start, packed_bytes, compression, whole_bytes = self._chunks[chunk]
                    file.seek(start)
                    kept[chunk] = unpack(file.read(packed_bytes), compression, whole_bytes)
                    unpacked += len(kept[chunk])
                    check_unpacked(self._size, unpacked, _REREAD_RATIO)
                    while len(kept) > 1 and sum(map(len, kept.values())) > _KEPT_BYTES:
                        del kept[next(iter(kept))]
                return kept[chunk][offset : offset + size]

            yield payload

    def _records(self, file: BinaryIO, chunk: int = -1) -> Iterator[StoredMessage]:
        return self._mcap_records(file, chunk) if self._is_mcap else self._ros1_records(file, chunk)

    def _mcap_records(self, file: BinaryIO, chunk: int) -> Iterator[StoredMessage]:
        while head := file.read(9):
            opcode, size = struct.unpack("<cQ", head)
            if opcode == _DATA_END:
                return
            if opcode == b"\0":
                raise DamageError
            start, content = file.tell(), _read(file, size)
            is_cut = len(content) < size
            if opcode == _CHUNK and chunk < 0:
                whole_bytes, crc = struct.unpack_from("<QI", content, 16)
                compression, at = _text(content, 28)
                packed_bytes, at = int.from_bytes(content[at : at + 8], "little"), at + 8
                packed = start + at, packed_bytes, compression, whole_bytes
                yield from self._in_chunk(packed, content[at : at + packed_bytes], 0 if is_cut else crc)
            if is_cut:
                raise DamageError
            if opcode == _SCHEMA:
                self._schemas[int.from_bytes(content[:2], "little")] = _text(content, 2)[0]
            elif opcode == _CHANNEL:
                self._add_channel(content)
            elif opcode == _MESSAGE:
                channel, _, time_ns, _ = struct.unpack_from("<HIQQ", content)
                if channel in self.topics:
                    place = chunk, start + 22, size - 22
                    yield StoredMessage(*self.topics[channel], time_ns, content[22:], place)
            elif opcode == _HEADER:
                self._schemas.clear()
        if chunk < 0:
            raise DamageError  # there is no end of the data

    def _add_channel(self, content: bytes) -> None:
        channel, schema = struct.unpack_from("<HH", content)
        topic, at = _text(content, 4)
        encoding, _ = _text(content, at)
        self.ros1 = self.ros1 or encoding == "ros1"
        self.topics.setdefault(channel, (topic, _kind(self._schemas.get(schema, ""), encoding)))

    def _ros1_records(self, file: BinaryIO, chunk: int) -> Iterator[StoredMessage]:
        while head := file.read(4):
            fields = _ros1_fields(_exactly(file, int.from_bytes(head, "little")))
            operation = fields[b"op"]
            size = int.from_bytes(_exactly(file, 4), "little")
            start, content = file.tell(), _read(file, size)
            if operation == _ROS1_CHUNK and chunk < 0:
                compression = fields[b"compression"].decode(errors="replace")
                packed = start, size, compression, int.from_bytes(fields[b"size"], "little")
                yield from self._in_chunk(packed, content)
            if len(content) < size:
                raise DamageError
            if operation == _ROS1_CONNECTION:
                stated = {**_ros1_fields(content), **fields}
                topic, kind = (stated[key].decode(errors="replace") for key in (b"topic", b"type"))
                self.topics.setdefault(int.from_bytes(stated[b"conn"], "little"), (topic, kind))
            elif operation == _ROS1_MESSAGE:
                seconds, nanoseconds = struct.unpack("<II", fields[b"time"])
                connection = int.from_bytes(fields[b"conn"], "little")
                if connection in self.topics:
                    time_ns, place = seconds * NANOSECONDS + nanoseconds, (chunk, start, size)
                    yield StoredMessage(*self.topics[connection], time_ns, content, place)

    def _in_chunk(self, chunk: tuple[int, int, str, int], packed: bytes, crc: int = 0) -> Iterator[StoredMessage]:
        """The messages of a chunk, as many as there are; ``crc`` 0: not checked."""
        _, _, compression, size = chunk
        if size > LARGEST_CHUNK_BYTES:
            raise DamageError(f"a chunk of {size / 1e6:.0f} MB would fill the memory")
        records = unpack(packed, compression, size)
        if len(records) == size and crc and crc32(records) != crc:
            raise DamageError
        self._unpacked += len(records)
        check_unpacked(self._size, self._unpacked, MOST_STREAM_RATIO)
        self._chunks.append(chunk)
        yield from self._records(BytesIO(records), len(self._chunks) - 1)
        if len(records) < size:
            raise DamageError


class DatabaseFile:
    """An SQLite file of ROS 2."""

    ros1 = False
    damage = ""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.topics: dict[int, tuple[str, str]] = {}

    def messages(self) -> Iterator[StoredMessage]:
        """As ``RecordFile.messages``; a damaged database raises an error."""
        _check_database(self.path)
        with closing(open_database(self.path)) as database:
            self.topics = {
                number: (name, _kind(kind, encoding))
                for number, name, kind, encoding in database.execute(
                    "SELECT id, name, type, serialization_format FROM topics WHERE typeof(name) = 'text'"
                )
            }
            for row, topic, time_ns, payload in database.execute(
                "SELECT id, topic_id, timestamp, data FROM messages ORDER BY id"
            ):
                if not (isinstance(row, int) and isinstance(payload, bytes) and isinstance(time_ns, int)):
                    raise DamageError(f"message {row} is not bytes with a time")
                if topic in self.topics:
                    yield StoredMessage(*self.topics[topic], time_ns, payload, (-1, row, 0))

    @contextmanager
    def reading(self) -> Iterator[Callable[[MessagePlace], bytes]]:
        """As ``RecordFile.reading``."""
        with closing(open_database(self.path)) as database:

            def payload(place: MessagePlace) -> bytes:
                _, row, _ = place
                (content,) = database.execute("SELECT data FROM messages WHERE id = ?", (row,)).fetchone()
                return bytes(content)

            yield payload


def _check_database(database: Path) -> None:
    """Reject a database that was not closed or is truncated; SQLite would read the rest without an error."""
    journal = database.with_name(f"{database.name}-wal")
    if journal.exists() and journal.stat().st_size:
        raise ValueError(
            f"it was not closed, {journal.name} holds its end; close it with "
            f'`sqlite3 {database.name} "PRAGMA wal_checkpoint(TRUNCATE)"`'
        )
    with open_file(database) as file:
        header = file.read(_SQLITE_HEADER_BYTES)
    page_bytes, changes, pages, counted_at = (
        int.from_bytes(header[start:end], "big") for start, end in ((16, 18), (24, 28), (28, 32), (92, 96))
    )
    if changes == counted_at and database.stat().st_size < page_bytes * pages:
        raise ValueError("the file is truncated")


def _kind(stated: str, encoding: str) -> str:
    kind = stated.replace("/msg/", "/")
    return kind if encoding in ("cdr", "ros1") else f"{kind}{OTHER_ENCODING}{encoding}"


def _ros1_fields(content: bytes) -> dict[bytes, bytes]:
    fields, at = dict[bytes, bytes](), 0
    while at < len(content):
        end = at + 4 + int.from_bytes(content[at : at + 4], "little")
        name, equals, value = content[at + 4 : end].partition(b"=")
        if not equals or end > len(content):
            raise DamageError
        fields[name], at = value, end
    return fields


def _read(file: BinaryIO, size: int) -> bytes:
    """``size`` bytes, or fewer where the file is cut off."""
    if size > LARGEST_CHUNK_BYTES:
        raise DamageError
    return file.read(size)


def _exactly(file: BinaryIO, size: int) -> bytes:
    content = _read(file, size)
    if len(content) < size:
        raise DamageError
    return content


def _text(content: bytes, at: int) -> tuple[str, int]:
    start = at + 4
    end = start + int.from_bytes(content[at:start], "little")
    if end > len(content):
        raise DamageError
    return content[start:end].decode(errors="replace"), end
