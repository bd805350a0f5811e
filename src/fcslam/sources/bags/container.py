"""Reads a bag, a file or a folder, as a stream of raw messages.

The message definitions in a bag are ignored. The few types that are read have never changed, and so an invalid
definition of another topic does no harm.
"""

import os
from collections import Counter
from collections.abc import Collection, Generator, Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass
from functools import cached_property
from heapq import merge
from itertools import repeat
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO, NamedTuple, Protocol, cast

from fcslam.config import one_line
from fcslam.errors import SourceError
from fcslam.sources.bags.codec import OLD_TRANSFORMS, SCANS, TRANSFORMS, MessageCodec
from fcslam.sources.bags.limited_rosbags import METADATA, check_chunks, ros1_reader, ros2_reader
from fcslam.sources.bags.mcap_records import MCAP_MAGIC, chunk_bytes, profile_of
from fcslam.sources.bags.sequential import LARGEST_CHUNK_BYTES, SequentialReader
from fcslam.sources.logs.archive import translate_errors
from fcslam.untrusted import MOST_CHUNKS_RATIO, check_unpacked, open_database, open_file, unpack

if TYPE_CHECKING:
    from rosbags.interfaces import Connection

_ROS1, _MCAP, _SQLITE = b"#ROSBAG V", MCAP_MAGIC, b"SQLite format 3\x00"
_PROFILE = "ros2"
_LONGEST_REASON = 200
_SQLITE_HEADER_BYTES = 100
_LONGEST_TOPIC = 255
"""Characters in a topic's name, as in ROS 2."""
ZSTD = b"\x28\xb5\x2f\xfd"
"""The first bytes of a file or message in zstd; only the metadata beside a file states this compression."""
_LONGEST_PAUSE_NS, _LONGEST_OVERLAP_NS = 60 * 10**9, 10**9
"""Of the scans in two parts of one recording, from the end of one to the beginning of the next."""


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
        return any(_parts_in(path))
    return head.startswith((_ROS1, _MCAP, _SQLITE))


def parts_of(path: Path) -> tuple[Path, ...]:
    """The parts of one recording: those in a folder without metadata, or several joined by commas; else the path."""
    if os.path.isdir(path):
        with translate_errors(path):
            return tuple(_parts_in(path)) or (path,)
    names = str(path).split(",")
    return (path,) if os.path.lexists(path) or not all(names) else tuple(map(Path, names))


@dataclass(frozen=True)
class BagFile:
    """A bag; every pass over its messages opens it again.

    It may consist of several files, parts of one recording. Their messages are merged by the times of recording.
    """

    path: Path

    @cached_property
    def topics(self) -> tuple[Topic, ...]:
        """All topics, sorted by name; a topic with two types is listed twice."""
        counts: Counter[tuple[str, str]] = Counter()
        for part in self._parts:
            with part.opened() as reader:
                for connection in reader.connections:
                    if len(connection.topic) > _LONGEST_TOPIC:
                        length = len(connection.topic)
                        raise SourceError(f"{part.path}: a topic's name has {length} characters; {part.remedy}")
                    counts[connection.topic, _type_of(connection)] += connection.msgcount
        return tuple(Topic(name, kind, count) for (name, kind), count in sorted(counts.items()))

    @property
    def notes(self) -> tuple[str, ...]:
        """How each part was read without an index, as sentences; complete after a pass over all messages."""
        return tuple(part.note for part in self._parts if part.note)

    def messages(self, topics: Sequence[Topic]) -> Iterator[RawMessage]:
        """The messages of ``topics`` in the order of recording; at equal times in the order of ``topics``.

        Memory use does not depend on the bag's length, except for the index of a ROS 1 bag.

        Raises:
            SourceError: the bag cannot be read to its end, or its parts are not of one recording.
        """
        numbers: Counter[Topic] = Counter()
        order = PartOrder()
        with ExitStack() as opened:  # a reader that stops early must not leave a part open
            streams = [
                zip(repeat(part), opened.enter_context(closing(part.messages(topics))), strict=False)
                for part in self._parts
            ]
            for part, (topic, bag_time_ns, payload) in merge(*streams, key=lambda found: found[1][1]):
                if len(streams) > 1 and topic.type in SCANS:
                    order.check(topic.name, part.path, bag_time_ns)
                numbers[topic] += 1
                yield RawMessage(topic, numbers[topic], bag_time_ns, payload)

    def decode(self, message: RawMessage) -> Any:
        """Decode a message to an object of rosbags.

        Raises:
            ValueError: the bytes are not a message of its type.
        """
        payload = message.payload
        if not self._codec.ros1 and payload.startswith(ZSTD):
            payload = unpack(payload, "zstd")
        return self._codec.decode(payload, message.topic.type)

    @cached_property
    def _codec(self) -> MessageCodec:
        return MessageCodec(self._parts[0].is_ros1)

    @cached_property
    def _parts(self) -> "tuple[_Part, ...]":
        """The files; those of a folder one by one if a file was not closed, as its metadata is then wrong."""
        paths: list[Path] = []
        for path in parts_of(self.path):
            is_cut = path.is_dir() and any(map(_is_cut_mcap, path.glob("*.mcap")))
            paths += _storage_files(path) if is_cut else [path]
        if len({path.resolve() for path in paths}) < len(paths):
            raise SourceError(f"{self.path}: a file is given twice; give each part of the recording once")
        parts = tuple(map(_Part, paths))
        if len({part.is_ros1 for part in parts}) > 1:
            raise SourceError(f"{self.path}: has bags of ROS 1 and of ROS 2; give the parts of one recording")
        return parts


class PartOrder:
    """Checks that the scans of several files are those of one recording."""

    def __init__(self) -> None:
        self._last: dict[str, tuple[Path, int]] = {}
        self._left_ns: dict[tuple[str, Path], int] = {}
        """When another file first went on with a topic."""

    def check(self, topic: str, part: Path, time_ns: int) -> None:
        """Check the next scan of a topic."""
        before, before_ns = self._last.get(topic, (part, time_ns))
        self._last[topic] = part, time_ns
        if before == part:
            return
        self._left_ns.setdefault((topic, before), before_ns)
        if time_ns - before_ns > _LONGEST_PAUSE_NS:
            raise SourceError(
                f"{part}: begins {(time_ns - before_ns) / 1e9:.0f} s after {before} ends, so they are not parts "
                "of one drive; give each as a recording of its own"
            )
        if time_ns - self._left_ns.get((topic, part), time_ns) > _LONGEST_OVERLAP_NS:
            raise SourceError(
                f"{part}: has scans in {topic} of the same time as {before}, so they are not parts of one drive; give "
                "each as a recording of its own, NAME=PATH"
            )


class _Part:
    """One file of a bag, or a folder of files with their metadata."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._without_index: SequentialReader | None = None
        self._reason = ""
        """Why it is read without its index."""

    @property
    def note(self) -> str:
        """How it was read if not by its index."""
        if self._without_index is None:
            return ""
        at, size = self._without_index.damage_bytes, self._without_index.size_bytes
        end = "" if at is None else f", up to {at / 1e6:.3f} of {size / 1e6:.3f} MB, where it is cut off or damaged"
        return f"{self.path}: read in the order of its records, without an index ({self._reason}){end}"

    @cached_property
    def _magic(self) -> bytes:
        if self.path.is_dir():
            return b""
        with translate_errors(self.path), open_file(self.path) as file:
            return file.read(len(_SQLITE))

    @property
    def is_ros1(self) -> bool:
        """Whether it is a bag of ROS 1."""
        return self._magic.startswith(_ROS1)

    def messages(self, topics: Sequence[Topic]) -> Generator[tuple[Topic, int, bytes], None, None]:
        """The messages of ``topics``: by the index, and without it from where it proves wrong."""
        count = times = 0
        try:
            with self.opened() as reader:
                for found in _chosen(reader, topics):
                    count, times = count + 1, hash((times, found[1]))
                    yield found
            return
        except SourceError as error:
            if not self._leaves_index(error.__cause__ or error):
                raise
            refused = error
        again = 0
        with self.opened() as reader:
            for number, found in enumerate(_chosen(reader, topics)):
                if number < count:
                    again = hash((again, found[1]))
                elif again != times:  # the order by the index was another one
                    raise refused
                else:
                    yield found

    @contextmanager
    def opened(self) -> Iterator[_Reader]:
        """Open a reader and translate all errors to SourceError; rosbags raises many types on damaged files."""
        try:
            reader = self._without_index or self._by_index()
            try:
                yield reader
            finally:
                reader.close()
        except SourceError:
            raise
        except Exception as error:
            raise SourceError(f"{self.path}: the bag cannot be read ({_short(error)}); {self.remedy}") from error

    def _by_index(self) -> _Reader:
        """The opened reader; one without the index if that is missing or contradicts itself."""
        reader = _reader(self._checked_path, self._magic)
        try:
            reader.open()
            try:
                _read_without_index(reader)
                if self.is_ros1:
                    _check_counts(reader)
            except BaseException:
                reader.close()
                raise
        except Exception as error:
            if self._leaves_index(error) and self._without_index is not None:
                return self._without_index
            raise
        return reader

    def _leaves_index(self, error: BaseException) -> bool:
        """Go on without the index, if there are messages to read then."""
        if self._without_index is not None or not self._magic.startswith((_ROS1, _MCAP)):
            return False
        reader = SequentialReader(self.path, self.is_ros1)
        reader.open()
        if not any(connection.msgcount for connection in reader.connections):
            return False
        self._without_index, self._reason = reader, _short(error)
        return True

    @cached_property
    def _checked_path(self) -> Path:
        """The path; files of MCAP are looked through once before, as they could fill the memory."""
        for path in self.path.glob("*.mcap") if self.path.is_dir() else [self.path]:
            with open_file(path) as file:
                if file.read(len(MCAP_MAGIC)) == MCAP_MAGIC:
                    _check_mcap(path, file)
        return self.path

    @property
    def remedy(self) -> str:
        """Commands that mend a damaged file of this kind."""
        of_ros2 = "mcap recover" if self._magic.startswith(_MCAP) else "ros2 bag reindex"
        return f"copy it again, or mend it with `{'rosbag reindex' if self.is_ros1 else of_ros2}`"


def _chosen(reader: _Reader, topics: Sequence[Topic]) -> Iterator[tuple[Topic, int, bytes]]:
    chosen = [
        (connection, topic)
        for topic in topics
        for connection in reader.connections
        if (connection.topic, _type_of(connection)) == (topic.name, topic.type)
    ]
    topic_of = {connection.id: topic for connection, topic in chosen}
    if not chosen:  # rosbags would read all topics
        return
    for connection, bag_time_ns, payload in reader.messages([connection for connection, _ in chosen]):
        yield topic_of[connection.id], bag_time_ns, payload


def _short(error: BaseException) -> str:
    return " ".join(str(error).split())[:_LONGEST_REASON].rstrip(".") or type(error).__name__


def _is_cut_mcap(path: Path) -> bool:
    with open_file(path) as file:
        if file.read(len(MCAP_MAGIC)) != MCAP_MAGIC:
            return False
        file.seek(-len(MCAP_MAGIC), os.SEEK_END)
        return file.read() != MCAP_MAGIC


def _check_counts(reader: Any) -> None:
    """Reject an index of a ROS 1 bag whose two counts of messages differ."""
    chunks = Counter[int]()
    for info in reader.chunk_infos:
        chunks.update(info.connection_counts)
    if any(len(reader.indexes[each.id]) != chunks[each.id] for each in reader.connections):
        raise ValueError("the index contradicts its chunks")


def is_transforms(topic: Topic) -> bool:
    """Whether the topic carries tf."""
    return topic.type in (TRANSFORMS, OLD_TRANSFORMS)


def _reader(path: Path, magic: bytes) -> _Reader:
    for database in path.glob("*.db3") if path.is_dir() else [path] * magic.startswith(_SQLITE):
        _check_database(database)
    if magic.startswith(_ROS1):
        return cast(_Reader, ros1_reader(path))
    suffixes = {_SQLITE: ".db3", _MCAP: ".mcap"}
    suffix = "dir" if path.is_dir() else next((suffixes[start] for start in suffixes if magic.startswith(start)), None)
    if suffix is None:
        raise SourceError(f"{path}: the whole bag is compressed; unpack it first, as by `gunzip`, `xz -d` or `zstd -d`")
    return cast(_Reader, ros2_reader(path, suffix))


def _check_mcap(path: Path, file: BinaryIO) -> None:
    profile, chunks = profile_of(file), list(chunk_bytes(file))
    if profile is not None and profile != _PROFILE:
        raise SourceError(
            f"{path}: has the profile {one_line(repr(profile))}, and the bags of ROS 2 have {_PROFILE!r}; "
            "write it again with this profile, as `ros2 bag convert` does"
        )
    if max(chunks, default=0) > LARGEST_CHUNK_BYTES:
        raise SourceError(
            f"{path}: has a chunk of {max(chunks) / 1e6:.0f} MB, which would fill the memory; "
            "write it again with smaller chunks, as `mcap compress` does"
        )
    check_unpacked(os.fstat(file.fileno()).st_size, sum(chunks), MOST_CHUNKS_RATIO)


def _read_without_index(reader: Any) -> None:
    """Let rosbags read a file whose chunks have no index of their messages from its beginning; it would find none."""
    from rosbags import rosbag2

    for storage in getattr(reader, "storages", [reader]):
        is_mcap = isinstance(storage, rosbag2.Reader.STORAGE_PLUGINS[".mcap"])
        if is_mcap:
            check_chunks(storage)
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
    with open_file(database) as file:
        header = file.read(_SQLITE_HEADER_BYTES)
    page_bytes, changes, pages, counted_at = (
        int.from_bytes(header[start:end], "big") for start, end in ((16, 18), (24, 28), (28, 32), (92, 96))
    )
    if changes == counted_at and database.stat().st_size < page_bytes * pages:
        raise ValueError("the file is truncated")
    open_database(database).close()  # refuses what is more than tables


def _parts_in(folder: Path) -> list[Path]:
    """The folder itself if it has metadata, else the files of bags in it, else those in its folders."""
    if (folder / METADATA).is_file():
        return [folder]
    if files := _storage_files(folder):
        return files
    inner = sorted(path for path in folder.iterdir() if path.is_dir())
    return [part for path in inner for part in ([path] if (path / METADATA).is_file() else _storage_files(path))]


def _storage_files(folder: Path) -> list[Path]:
    return sorted(path for path in folder.iterdir() if path.suffix in (".mcap", ".db3", ".bag", ".active"))


def _type_of(connection: "Connection") -> str:
    kind = connection.msgtype.replace("/msg/", "/")
    encoding = getattr(connection.ext, "serialization_format", "cdr")
    return kind if encoding == "cdr" else f"{kind} as {encoding}"
