"""The frames in a bag: of its scans, of its odometry and in tf, from one pass over it."""

from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from heapq import merge
from pathlib import Path
from tempfile import gettempdir
from typing import Any, Final, NamedTuple

from fcslam.errors import SourceError
from fcslam.records import Transform
from fcslam.sources.bags.codec import LASER_SCANS, ODOMETRY, SCANS
from fcslam.sources.bags.container import BagFile, RawMessage, Topic, is_transforms
from fcslam.sources.bags.messages import OdometryReading, ScanMessage, header_of, odometry_of, scan_of, transforms_of
from fcslam.sources.bags.tape import Content, Tape
from fcslam.sources.bags.transforms import TransformTree, differ

UNSET_SHARE: Final = 0.5
"""Share of the messages that repeat the stamp of the one before if nobody sets it, or not its nanoseconds."""
_STAMP_END: Final = 12
"""Bytes of a message up to the end of its stamp, in ROS 1 and in ROS 2."""
FEWEST_REPEATS: Final = 20
"""Fewer repeated stamps say nothing."""
SAME_TIME_NS: Final = 100_000
"""Writers of bags put messages of one time in order by shorter steps."""

Stamped = tuple[Topic, str, str]
"""Messages of one driver: a topic of scans or odometry and two empty names, or one of tf with the parent and
the child of a transform."""


@dataclass(slots=True)
class Broken:
    """The messages of a topic that are invalid."""

    first: int
    """Number of the first one in its topic, from 1."""
    error: str
    """Its fault."""
    count: int = 0


@dataclass(slots=True)
class Clock:
    """Counts successive messages that have one stamp, but not the same content."""

    changes: int = 0
    """Messages that differ from the one before."""
    repeats: int = 0
    """Those with its stamp."""
    recorded: int = 0
    """Those of them that were recorded later than the one before."""
    _before: tuple[float, int, object, object] = (0.0, 0, None, None)

    def add(self, stamp: float, bag_time_ns: int, sensor: object, content: object) -> None:
        """Add the next message; ``sensor`` says which of several made it."""
        before, self._before = self._before, (stamp, bag_time_ns, sensor, content)
        self.changes += before[3] != content
        if (before[0], before[2]) == (stamp, sensor) and before[3] != content:
            self.repeats += 1
            self.recorded += bag_time_ns - before[1] > SAME_TIME_NS

    @property
    def is_unset(self) -> bool:
        """Whether the stamps do not say when each message was made."""
        return self.repeats > max(FEWEST_REPEATS, UNSET_SHARE * self.changes)

    @property
    def is_recorded(self) -> bool:
        """Whether the times of recording say it."""
        return 2 * self.recorded > self.repeats


@dataclass(slots=True)
class Census:
    """The frames that the messages of a bag name."""

    scan_frames: dict[Topic, Counter[str]] = field(default_factory=dict)
    """Frames of the scans on each topic, with their numbers of messages."""
    base_frames: dict[Topic, Counter[str]] = field(default_factory=dict)
    """Child frames on each topic of odometry."""
    links: dict[tuple[Topic, str, str], list[Transform]] = field(default_factory=dict)
    """Transforms on a topic of tf from a parent to a child: the first, and the first that differs from it."""
    broken: dict[Topic, Broken] = field(default_factory=dict)
    clocks: dict[Stamped, Clock] = field(default_factory=dict)

    def tree(self, topics: Iterable[Topic]) -> TransformTree:
        """The frames and transforms on these topics."""
        tree, chosen = TransformTree(), set(topics)
        for (topic, parent, child), transforms in self.links.items():
            for transform in transforms if topic in chosen else ():
                tree.add(parent, child, transform)
        return tree

    def has_recorded_clock(self, stamped: Stamped) -> bool:
        """Whether the times of recording of these messages count, as nobody sets their stamps."""
        clock = self.clocks.get(stamped)
        return clock is not None and clock.is_unset and clock.is_recorded

    def count(self, message: RawMessage, content: Any) -> Content | None:
        """Count an object of rosbags and convert it; None for a point cloud. Raises ValueError if it is invalid."""
        topic, now_ns = message.topic, message.bag_time_ns
        clock = self.clocks.setdefault((topic, "", ""), Clock())
        if topic.type in SCANS:
            stamp, frame = header_of(content.header, now_ns)
            self.scan_frames.setdefault(topic, Counter())[frame] += 1
            clock.add(stamp, now_ns, (frame, getattr(content, "angle_min", 0.0)), message.payload[_STAMP_END:])
            return scan_of(content, now_ns) if topic.type in LASER_SCANS else None
        if topic.type == ODOMETRY:
            reading = odometry_of(content, now_ns)
            self.base_frames.setdefault(topic, Counter())[reading.base_frame] += 1
            clock.add(reading.stamp, now_ns, reading.base_frame, reading.T_odom_base)
            return reading
        transforms = list(transforms_of(content, now_ns))
        for stamp, parent, child, transform in transforms:
            link = topic, parent, child
            self.clocks.setdefault(link, Clock()).add(stamp, now_ns, "", transform)
            seen = self.links.setdefault(link, [transform])
            if len(seen) == 1 and differ(seen[0], transform):
                seen.append(transform)
        return transforms

    def stamped(self, topic: Topic, time_ns: int, content: Content) -> Content:
        """A message with its time of recording as its stamp, if nobody sets that."""
        if isinstance(content, ScanMessage | OdometryReading):
            return content._replace(stamp=time_ns / 10**9) if self.has_recorded_clock((topic, "", "")) else content
        if isinstance(content, list):
            return [
                each._replace(stamp=time_ns / 10**9)
                if self.has_recorded_clock((topic, each.parent, each.child))
                else each
                for each in content
            ]
        return content


class BagMessage(NamedTuple):
    """A decoded message of a bag."""

    topic: Topic
    number: int
    """Counts the topic's messages from 1."""
    bag_time_ns: int
    """When it was recorded."""
    decoded: Any
    """Of laser scans, odometry and tf as in ``Content``; of other types an object of rosbags. An error if invalid."""

    @property
    def content(self) -> Any:
        """What was decoded; raises ValueError if the message is invalid."""
        if isinstance(self.decoded, ValueError):
            raise self.decoded
        return self.decoded


@dataclass(frozen=True)
class DecodedBag(BagFile):
    """A bag whose laser scans, odometry and transforms are decoded and counted once.

    Point clouds and images are too large to be kept; they are decoded whenever they are read.
    """

    def __reduce__(self) -> "tuple[type[DecodedBag], tuple[Path]]":
        return DecodedBag, (self.path,)  # a copy in another process decodes the bag again

    @property
    def census(self) -> Census:
        """The frames of all scans, odometry and transforms; those of messages that are invalid are left out."""
        return self._census_and_tape[0]

    def read(self, topics: Collection[Topic]) -> Iterator[BagMessage]:
        """The messages of ``topics`` in the order of recording."""
        kept = [topic for topic in topics if _is_kept(topic)]
        others = [topic for topic in topics if not _is_kept(topic)]
        streams = [*[self._kept_messages(kept)] * bool(kept), *[self._other_messages(others)] * bool(others)]
        return merge(*streams, key=lambda message: message.bag_time_ns)

    def _kept_messages(self, topics: Sequence[Topic]) -> Iterator[BagMessage]:
        census, tape = self._census_and_tape
        topic_of = {self.topics.index(topic): topic for topic in topics}
        counts = Counter[int]()
        for at, time_ns, content in tape.read(topic_of):
            counts[at] += 1
            yield BagMessage(topic_of[at], counts[at], time_ns, census.stamped(topic_of[at], time_ns, content))

    def _other_messages(self, topics: Sequence[Topic]) -> Iterator[BagMessage]:
        for message in self.messages(topics):
            content: Any
            try:
                content = self.decode(message)
                if self.census.has_recorded_clock((message.topic, "", "")):
                    content.header.stamp.sec = content.header.stamp.nanosec = 0
            except ValueError as error:
                content = error
            yield BagMessage(*message[:3], content)

    @cached_property
    def _census_and_tape(self) -> tuple[Census, Tape]:
        census = Census()
        kinds = [topic for topic in self.topics if topic.type in (*SCANS, ODOMETRY) or is_transforms(topic)]
        kinds.sort(key=lambda topic: topic.type in SCANS)  # at equal times, odometry comes first
        numbers = {topic: at for at, topic in enumerate(self.topics)}
        try:
            tape = Tape()
            for message in self.messages(kinds):
                content: Content | None
                try:
                    content = census.count(message, self.decode(message))
                except ValueError as error:
                    content = error
                    census.broken.setdefault(message.topic, Broken(message.number, str(error))).count += 1
                if content is not None and _is_kept(message.topic):
                    tape.add(numbers[message.topic], message.bag_time_ns, content)
            tape.finish()
        except OSError as error:
            raise SourceError(
                f"{gettempdir()}: decoded messages of {self.path} cannot be kept there ({error}); free some space, or "
                "name another folder by TMPDIR"
            ) from error
        return census, tape


def _is_kept(topic: Topic) -> bool:
    return topic.type in (*LASER_SCANS, ODOMETRY) or is_transforms(topic)
