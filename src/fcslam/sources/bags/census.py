"""The messages by which a robot is planned. Those of a bag come from one pass over its files.

Laser scans, odometry and transforms are decoded in this pass and kept in a temporary file. Point clouds and images are
too large for that; they are decoded whenever they are read.
"""

import json
import os
from abc import ABC, abstractmethod
from array import array
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field
from functools import cached_property
from itertools import chain
from pathlib import Path
from statistics import median
from tempfile import TemporaryFile, gettempdir
from typing import Any, Final, NamedTuple, TypeVar
from weakref import finalize

import numpy as np
from numpy.typing import NDArray

from fcslam.errors import SourceError
from fcslam.records import Beams, Sweep, Transform
from fcslam.sources.bags.codec import (
    CAMERA_INFO,
    COMPRESSED_IMAGE,
    FIX,
    IMAGE,
    IMU,
    LASER_SCANS,
    NANOSECONDS,
    ODOMETRY,
    SCANS,
    TRANSFORM_KINDS,
    MessageCodec,
)
from fcslam.sources.bags.container import BagPart, Topic, check_order, open_parts
from fcslam.sources.bags.messages import (
    LONGEST_NAME,
    OdometryReading,
    ScanMessage,
    StampedTransform,
    header_of,
    odometry_of,
    scan_of,
    stamp_ns_of,
    transforms_of,
)
from fcslam.sources.bags.records import MessagePlace, StoredMessage
from fcslam.sources.bags.transforms import Link, TransformTree, difference
from fcslam.sources.gate import FIRST_MESSAGES
from fcslam.untrusted import ZSTD, LimitError, unpack

_LATEST_NS: Final = int(np.iinfo(np.int64).max)
"""Larger times are of a damaged file."""
_ROWS_AT_ONCE: Final = 256
_KEPT: Final = (*LASER_SCANS, ODOMETRY, *TRANSFORM_KINDS)
_COUNTED: Final = (*SCANS, ODOMETRY, *TRANSFORM_KINDS)
_CLOCKED: Final = (FIX, IMU)
"""Types of which only the stamps of the first messages are looked at."""
_READ: Final = (*_COUNTED, IMAGE, COMPRESSED_IMAGE, CAMERA_INFO, FIX, IMU)


Found = TypeVar("Found")

Content = ScanMessage | OdometryReading | list[StampedTransform] | ValueError
"""A decoded message, or why it is invalid."""


@dataclass
class TopicCensus:
    """What the messages of a topic name, in the order of the files."""

    number: int
    count: int = 0
    span_ns: tuple[int, int] = (0, 0)
    frames: Counter[str] = field(default_factory=Counter)
    """Frames of scans, or child frames of odometry, with their numbers of messages."""
    links: dict[Link, list[Transform]] = field(default_factory=dict)
    """Transforms of tf from a parent to a child: the first, and the first ones that differ from it in each way."""
    odom_frames: set[str] = field(default_factory=set)
    """Parent frames of odometry."""
    unstamped: int = 0
    """Messages with a stamp of zero."""
    broken: int = 0
    """Messages that are invalid."""
    first_broken: int = 0
    """Number of the first of them, from 1."""
    error: str = ""
    _lags_s: list[float] = field(default_factory=list)

    @property
    def lags_s(self) -> list[float]:
        """Times from the stamps of the first messages to their recording, which count if none has a stamp."""
        return self._lags_s or [0.0] * min(self.unstamped, FIRST_MESSAGES)

    @property
    def lag_ns(self) -> int:
        """Time of recording less the clock of the stamps that are set, in whole milliseconds; 0 if none is missing."""
        return round(1e3 * median(self._lags_s)) * 10**6 if self.unstamped and self._lags_s else 0

    def add(self, time_ns: int) -> None:
        """Count a message."""
        first_ns, last_ns = self.span_ns if self.count else (time_ns, time_ns)
        self.count, self.span_ns = self.count + 1, (min(first_ns, time_ns), max(last_ns, time_ns))

    def forget(self) -> None:
        """Forget what the messages name: of a stream without end, it may be ever more."""
        for names in (self.frames, self.links, self.odom_frames):
            names.clear()

    def decoded(self, message: StoredMessage, ros1: bool) -> Any:
        """A message as in ``BagMessage``, after what it names is noted."""
        try:
            content = _decode(message.payload, message.kind, ros1)
            stamped = content.transforms if message.kind in TRANSFORM_KINDS else (content,)
            for each in stamped:
                stamp_ns = stamp_ns_of(each.header)
                self.unstamped += not stamp_ns
                if stamp_ns and len(self._lags_s) < FIRST_MESSAGES:
                    self._lags_s.append((message.time_ns - stamp_ns) / NANOSECONDS)
            if message.kind in SCANS:
                self.frames[header_of(content.header, message.time_ns)[1]] += 1
            found = content
            if message.kind in LASER_SCANS:
                found = scan_of(content, message.time_ns)
            elif message.kind == ODOMETRY:
                found = odometry_of(content, message.time_ns)
            elif message.kind in TRANSFORM_KINDS:
                found = list(transforms_of(content, message.time_ns))
        except ValueError as error:
            if not self.broken:
                self.first_broken, self.error = self.count, str(error)
            self.broken += 1
            return error
        if message.kind == ODOMETRY:
            self.frames[found.base_frame] += 1
            self.odom_frames.add(found.odom_frame)
        for _, parent, child, transform in found if message.kind in TRANSFORM_KINDS else ():
            seen = self.links.setdefault((parent, child), [transform])
            if difference(seen[0], transform) >= len(seen):
                seen.append(transform)
        return found


class BagMessage(NamedTuple):
    """A decoded message of a bag."""

    topic: Topic
    number: int
    """Counts the topic's messages from 1."""
    bag_time_ns: int
    unstamped_ns: int
    """Stamp of a message whose header has none."""
    decoded: Any
    """Laser scans, odometry and tf as in ``Content``; other types as objects of rosbags. An error if invalid."""

    @property
    def content(self) -> Any:
        """What was decoded; raises ValueError if the message is invalid."""
        if isinstance(self.decoded, ValueError):
            raise self.decoded
        return self.decoded

    def by_clock(self, lag_ns: int) -> "BagMessage":
        """The message with a stamp by the topic's clock, ``lag_ns`` behind that of recording, if it has none."""
        if not lag_ns:
            return self
        is_converted = self.topic.type in _KEPT
        decoded = _restamped(self.decoded, self.bag_time_ns, lag_ns) if is_converted else self.decoded
        return self._replace(unstamped_ns=self.bag_time_ns - lag_ns, decoded=decoded)


class Messages(ABC):
    """Messages by which a robot is planned: those of a bag, or the first ones of a live robot."""

    path: Path
    namespace = ""
    """Namespace of the robot, if the messages of tf may be of others, too."""

    @property
    def label(self) -> str:
        """What lines about them begin with."""
        return ""

    @property
    @abstractmethod
    def census(self) -> Mapping[Topic, TopicCensus]:
        """What the messages of each topic name; those that are invalid are left out."""

    @abstractmethod
    def read(self, topics: Collection[Topic]) -> Iterator[BagMessage]:
        """The messages of ``topics`` in the order of recording."""

    @property
    def topics(self) -> tuple[Topic, ...]:
        """All topics, sorted by name; a topic with two types is listed twice."""
        return tuple(self.census)

    @property
    def notes(self) -> tuple[str, ...]:
        """What is wrong with their files, as sentences."""
        return ()

    def tree(self, topics: Iterable[Topic]) -> TransformTree:
        """The frames and transforms of the robot on these topics of tf."""
        tree = TransformTree()
        for (parent, child), transforms in chain.from_iterable(self.census[topic].links.items() for topic in topics):
            space = child.rpartition("/")[0]
            for transform in transforms if not space or self.namespace in ("", space) else ():
                tree.add(parent, child, transform)
        return tree


@dataclass(frozen=True)
class DecodedBag(Messages):
    """A bag: one file, or several that are parts of one recording, merged by the times of recording.

    Any thread, and any copy of the process, may read it.
    """

    path: Path

    def __reduce__(self) -> "tuple[type[DecodedBag], tuple[Path]]":
        return DecodedBag, (self.path,)  # a copy in another process decodes the bag again

    @property
    def label(self) -> str:
        """As in ``Messages``."""
        return f"{self.path}: "

    @property
    def census(self) -> dict[Topic, TopicCensus]:
        """As in ``Messages``."""
        _, census, _, _ = self._index
        return census

    @property
    def notes(self) -> tuple[str, ...]:
        """Which files were not read to their end, as sentences."""
        parts, _, _, _ = self._index
        return tuple(part.note for part in parts if part.note)

    def read(self, topics: Collection[Topic]) -> Iterator[BagMessage]:
        """As in ``Messages``."""
        parts, census, rows, tape = self._index
        by_number = {census[topic].number: topic for topic in topics}
        lags_ns = {number: census[topic].lag_ns for number, topic in by_number.items()}
        counts: Counter[Topic] = Counter()
        with ExitStack() as opened:
            payloads: dict[int, Callable[[MessagePlace], bytes]] = {}
            for begin in range(0, len(rows), _ROWS_AT_ONCE):
                block = rows[begin : begin + _ROWS_AT_ONCE]
                for time_ns, number, at, chunk, offset, size in block[np.isin(block[:, 1], list(by_number))].tolist():
                    topic = by_number[number]
                    counts[topic] += 1
                    decoded: Any
                    if topic.type in _KEPT:
                        decoded = _unpacked(os.pread(tape, size, offset))
                    else:
                        with parts[at].translated():
                            if at not in payloads:
                                payloads[at] = opened.enter_context(parts[at].file.reading())
                            payload = payloads[at]((chunk, offset, size))
                        try:
                            decoded = _decode(payload, topic.type, parts[at].file.ros1)
                        except ValueError as error:
                            decoded = error
                    yield BagMessage(topic, counts[topic], time_ns, time_ns, decoded).by_clock(lags_ns[number])

    @cached_property
    def _index(self) -> tuple[tuple[BagPart, ...], dict[Topic, TopicCensus], NDArray[np.int64], int]:
        """The parts; the topics; the messages that can be read; the file descriptor of the decoded ones.

        A message is a row of its time, the numbers of its topic and its part, and its place. They are in order of time.
        """
        parts, rows = open_parts(self.path), array("q")
        found: dict[tuple[str, str], TopicCensus] = {}
        try:
            tape = TemporaryFile(prefix="fcslam-")  # noqa: SIM115  it lives as long as the bag
            finalize(self, tape.close)
            written = 0
            for at, part in enumerate(parts):
                count = 0
                for message in _messages(part):
                    count += 1
                    named = message.topic, message.kind
                    topic = found.get(named) or found.setdefault(named, TopicCensus(len(found)))
                    time_ns, place = min(message.time_ns, _LATEST_NS), message.place
                    topic.add(time_ns)
                    if message.kind not in _READ:
                        continue
                    if message.kind in _COUNTED or (message.kind in _CLOCKED and topic.count <= FIRST_MESSAGES):
                        content = topic.decoded(message, part.file.ros1)
                        if message.kind in _KEPT:
                            size = tape.write(_packed(content))
                            place, written = (-1, written, size), written + size
                    rows.extend((time_ns, topic.number, at, *place))
                for named in part.file.topics.values():
                    found.setdefault(named, TopicCensus(len(found)))
                if part.file.damage and not count:
                    raise part.refusal(f"it is cut off or damaged at {part.file.damage}")
            tape.flush()
        except OSError as error:
            raise SourceError(
                f"{gettempdir()}: decoded messages of {self.path} cannot be kept there ({error}); free some space, or "
                "name another folder by TMPDIR"
            ) from error
        table = np.frombuffer(rows, np.int64).reshape(-1, 6)
        census = {Topic(*named, topic.count): topic for named, topic in sorted(found.items())}
        by_number = sorted(census, key=lambda topic: census[topic].number)
        # At equal times odometry and tf come first, then laser scans.
        ranks = [(topic.type in SCANS) + 2 * (topic.type not in _KEPT) for topic in by_number]
        table = table[np.lexsort((np.array(ranks, np.int64)[table[:, 1]], table[:, 0]))]
        for read in census if len(parts) > 1 else ():
            own = table[table[:, 1] == census[read].number] if read.type in SCANS else table[:0]
            check_order(read.name, ((parts[at].path, time_ns) for time_ns, _, at, *_ in own.tolist()))
        return parts, census, table, tape.fileno()


def valid(messages: Iterable[BagMessage], convert: Callable[[BagMessage], Found]) -> Iterator[Found]:
    """The messages that can be converted."""
    for message in messages:
        try:
            found = convert(message)
        except ValueError:
            continue
        yield found


def _messages(part: BagPart) -> Iterator[StoredMessage]:
    with part.translated():
        for message in part.file.messages():
            if len(message.topic) > LONGEST_NAME:
                raise SourceError(
                    f"{part.path}: a topic's name has {len(message.topic)} characters; copy the bag again"
                )
            yield message


def _decode(payload: bytes, kind: str, ros1: bool) -> Any:
    if not ros1 and payload.startswith(ZSTD):
        try:
            payload = unpack(payload, "zstd")
        except LimitError as error:
            raise ValueError(str(error)) from error
    return MessageCodec(ros1).decode(payload, kind)


def _restamped(content: Any, now_ns: int, lag_ns: int) -> Any:
    """The content of a message by the clock of its topic: a stamp that is the time of recording was zero."""
    if isinstance(content, list):
        return [_restamped(each, now_ns, lag_ns) for each in content]
    if isinstance(content, ValueError) or content.stamp != now_ns / NANOSECONDS:
        return content
    return content._replace(stamp=(now_ns - lag_ns) / NANOSECONDS)


def _packed(content: Content) -> bytes:
    if isinstance(content, ScanMessage):
        fields = json.dumps(("scan", *content._replace(raw_ranges_m=None)))  # type: ignore[arg-type]
        return fields.encode() + b"\n" + content.raw_ranges_m.tobytes()
    if isinstance(content, ValueError):
        return json.dumps(("invalid", str(content))).encode()
    kind = "odometry" if isinstance(content, OdometryReading) else "transforms"
    return json.dumps((kind, *content)).encode()


def _unpacked(packed: bytes) -> Content:
    text, _, ranges = packed.partition(b"\n")
    kind, *fields = json.loads(text)
    if kind == "scan":
        stamp, frame, beams, low_m, high_m, _, laser, sweep, _ = fields
        raw_ranges_m = np.frombuffer(ranges, np.float32)
        return ScanMessage(
            stamp, frame, Beams(*beams), low_m, high_m, raw_ranges_m, laser, sweep and Sweep(sweep[0], sweep[1])
        )
    if kind == "odometry":
        stamp, pose, *frames = fields
        return OdometryReading(stamp, tuple(pose), *frames)
    if kind == "transforms":
        return [
            StampedTransform(stamp, parent, child, Transform(tuple(at), tuple(turn)))
            for stamp, parent, child, (at, turn) in fields
        ]
    return ValueError(*fields)
