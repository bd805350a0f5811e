"""Reads a bag, a file or a folder, as a stream of raw messages.

The message definitions in a bag are ignored. The few types that are read have never changed, and so an invalid
definition of another topic does no harm.
"""

from collections import Counter
from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO, NamedTuple, Protocol
from urllib.parse import quote

from fcslam.config import one_line
from fcslam.errors import SourceError
from fcslam.sources.bags.codec import OLD_TRANSFORMS, TRANSFORMS, MessageCodec
from fcslam.sources.bags.mcap_records import MCAP_MAGIC, largest_chunk_bytes, profile_of

if TYPE_CHECKING:
    from rosbags.interfaces import Connection

_ROS1, _MCAP, _SQLITE = b"#ROSBAG V", MCAP_MAGIC, b"SQLite format 3\x00"
_METADATA = "metadata.yaml"
_PROFILE = "ros2"
_LONGEST_REASON = 200
_SQLITE_HEADER_BYTES = 100
_LARGEST_CHUNK_BYTES = 256_000_000
"""Of a chunk of MCAP without compression, which is read as one; recorders write some megabytes."""
_LONGEST_TOPIC = 255
"""Characters in a topic's name, as in ROS 2."""


class Topic(NamedTuple):
    """A topic of a bag."""

    name: str
    type: str
    """Without ``msg/``, as ROS 1 writes it."""
    message_count: int


class RawMessage(NamedTuple):
    """One message, not decoded."""

    topic: Topic
    number: int
    """Counts the topic's messages from 1."""
    bag_time_ns: int
    """When it was recorded."""
    payload: bytes


class _Reader(Protocol):
    """Common interface of the readers of rosbags."""

    @property
    def connections(self) -> "list[Connection]": ...

    def open(self) -> None: ...

    def close(self) -> None: ...

    def messages(self, connections: "Collection[Connection]") -> "Iterator[tuple[Connection, int, bytes]]": ...


def is_bag(path: Path, head: bytes) -> bool:
    """Whether there is a bag at ``path``, a file that starts with ``head`` or a folder."""
    if path.is_dir():
        return (path / _METADATA).is_file() or any(_storage_files(path))
    return head.startswith((_ROS1, _MCAP, _SQLITE))


@dataclass(frozen=True)
class BagFile:
    """A bag; every pass over its messages opens it again."""

    path: Path

    @cached_property
    def topics(self) -> tuple[Topic, ...]:
        """All topics, sorted by name; a topic with two types is listed twice.

        Raises:
            SourceError: the bag is empty, damaged or has no index.
        """
        counts: Counter[tuple[str, str]] = Counter()
        with self._opened() as reader:
            for connection in reader.connections:
                if len(connection.topic) > _LONGEST_TOPIC:
                    length = len(connection.topic)
                    raise SourceError(f"{self.path}: a topic's name has {length} characters; {self._remedy()}")
                counts[connection.topic, _type_of(connection)] += connection.msgcount
        return tuple(Topic(name, kind, count) for (name, kind), count in sorted(counts.items()))

    def messages(self, topics: Sequence[Topic]) -> Iterator[RawMessage]:
        """The messages of ``topics`` in the order of recording; at equal times in the order of ``topics``.

        Memory use does not depend on the bag's length, except for the index of a ROS 1 bag.

        Raises:
            SourceError: the bag cannot be read to its end.
        """
        numbers: Counter[Topic] = Counter()
        with self._opened() as reader:
            chosen = [
                (connection, topic)
                for topic in topics
                for connection in reader.connections
                if (connection.topic, _type_of(connection)) == (topic.name, topic.type)
            ]
            topic_of = {connection.id: topic for connection, topic in chosen}
            for connection, bag_time_ns, payload in reader.messages([connection for connection, _ in chosen]):
                topic = topic_of[connection.id]
                numbers[topic] += 1
                yield RawMessage(topic, numbers[topic], bag_time_ns, payload)

    def decode(self, message: RawMessage) -> Any:
        """Decode a message to an object of rosbags.

        Raises:
            ValueError: the bytes are not a message of its type.
        """
        return self._codec.decode(message.payload, message.topic.type)

    @cached_property
    def _codec(self) -> MessageCodec:
        return MessageCodec(self._is_ros1)

    @cached_property
    def _magic(self) -> bytes:
        if self.path.is_dir():
            return b""
        with self.path.open("rb") as file:
            return file.read(len(_SQLITE))

    @property
    def _is_ros1(self) -> bool:
        return self._magic.startswith(_ROS1)

    @contextmanager
    def _opened(self) -> Iterator[_Reader]:
        """Open a reader and translate all errors to SourceError; rosbags raises many types on damaged files."""
        try:
            reader = _reader(self._checked_path, self._magic)
            reader.open()
            try:
                _read_without_index(reader)
                yield reader
            finally:
                reader.close()
        except SourceError:
            raise
        except Exception as error:
            reason = " ".join(str(error).split())[:_LONGEST_REASON].rstrip(".") or type(error).__name__
            raise SourceError(f"{self.path}: the bag cannot be read ({reason}); {self._remedy()}") from error

    @cached_property
    def _checked_path(self) -> Path:
        """The path; files of MCAP are looked through once before, as they could fill the memory.

        Raises:
            SourceError: one would fill the memory, or is none of ROS 2.
        """
        for path in self.path.glob("*.mcap") if self.path.is_dir() else [self.path]:
            with path.open("rb") as file:
                if file.read(len(MCAP_MAGIC)) == MCAP_MAGIC:
                    _check_mcap(path, file)
        return self.path

    def _remedy(self) -> str:
        if self._is_ros1:
            return "copy it again, or mend it with `rosbag reindex`"
        if self._magic.startswith(_MCAP):
            return "copy it again, or mend it with `mcap recover`"
        return "copy it again, or mend it with `ros2 bag reindex`"


def is_transforms(topic: Topic) -> bool:
    """Whether the topic carries tf."""
    return topic.type in (TRANSFORMS, OLD_TRANSFORMS)


def _reader(path: Path, magic: bytes) -> _Reader:
    from rosbags import rosbag1, rosbag2

    if path.is_dir():
        if not (path / _METADATA).is_file():
            raise SourceError(
                f"{path}: has bag files and no {_METADATA}; give one of the files, or make it with `ros2 bag reindex`"
            )
        for database in path.glob("*.db3"):
            _check_database(database)
        return rosbag2.Reader(path)
    if magic.startswith(_ROS1):
        return rosbag1.Reader(path)
    if magic.startswith(_SQLITE):
        _check_database(path)
        # rosbags puts the path into a URI as it is
        return rosbag2.Reader.STORAGE_PLUGINS[".db3"](Path(quote(str(path))))
    if magic.startswith(_MCAP):
        return rosbag2.Reader.STORAGE_PLUGINS[".mcap"](path)
    raise SourceError(f"{path}: the whole bag is compressed; unpack it first")


def _check_mcap(path: Path, file: BinaryIO) -> None:
    profile, chunk_bytes = profile_of(file), largest_chunk_bytes(file)
    if profile is not None and profile != _PROFILE:
        raise SourceError(
            f"{path}: has the profile {one_line(repr(profile))}, and the bags of ROS 2 have {_PROFILE!r}; "
            "write it again with this profile, as `ros2 bag convert` does"
        )
    if chunk_bytes > _LARGEST_CHUNK_BYTES:
        raise SourceError(
            f"{path}: has a chunk of {chunk_bytes / 1e6:.0f} MB, which would fill the memory; "
            "write it again with smaller chunks, as `mcap compress` does"
        )


def _read_without_index(reader: Any) -> None:
    """Let rosbags read a file whose chunks have no index of their messages from its beginning; it would find none."""
    from rosbags import rosbag2

    for storage in getattr(reader, "storages", [reader]):
        is_mcap = isinstance(storage, rosbag2.Reader.STORAGE_PLUGINS[".mcap"])
        if not is_mcap or any(chunk.message_index_offsets for chunk in storage.chunks):
            continue
        storage.chunks.clear()
        if not any(connection.msgcount for connection in storage.connections):
            storage.meta_scan()
            counts = storage.statistics.channel_message_counts
            storage.connections = [each._replace(msgcount=counts.get(each.id, 0)) for each in storage.connections]


def _check_database(database: Path) -> None:
    """Reject a database that was not closed or is truncated; SQLite would read the rest without an error."""
    journal = database.with_name(f"{database.name}-wal")
    if journal.exists() and journal.stat().st_size:
        raise SourceError(
            f"{database}: was not closed, {journal.name} holds its end; close it with "
            f'`sqlite3 {database.name} "PRAGMA wal_checkpoint(TRUNCATE)"`'
        )
    with database.open("rb") as file:
        header = file.read(_SQLITE_HEADER_BYTES)
    page_bytes, changes, pages, counted_at = (
        int.from_bytes(header[start:end], "big") for start, end in ((16, 18), (24, 28), (28, 32), (92, 96))
    )
    if changes == counted_at and database.stat().st_size < page_bytes * pages:
        raise ValueError("the file is truncated")


def _storage_files(folder: Path) -> Iterator[Path]:
    return (path for path in folder.iterdir() if path.suffix in (".mcap", ".db3"))


def _type_of(connection: "Connection") -> str:
    kind = connection.msgtype.replace("/msg/", "/")
    encoding = getattr(connection.ext, "serialization_format", "cdr")
    return kind if encoding == "cdr" else f"{kind} as {encoding}"
