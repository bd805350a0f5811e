"""The frames in a bag: of its scans, of its odometry and in tf, from one pass over it."""

from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Final

from fcslam.records import Transform
from fcslam.sources.bags.codec import ODOMETRY, SCANS
from fcslam.sources.bags.container import BagFile, RawMessage, Topic, is_transforms
from fcslam.sources.bags.messages import frame_of, header_of, odometry_of, transforms_of
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


@dataclass(frozen=True)
class CountedBag(BagFile):
    """A bag whose frames are counted once."""

    @cached_property
    def census(self) -> Census:
        """The frames of all scans, odometry and transforms; those of messages that are invalid are left out.

        Raises:
            SourceError: the bag cannot be read.
        """
        census = Census()
        kinds = [topic for topic in self.topics if topic.type in (*SCANS, ODOMETRY) or is_transforms(topic)]
        for message in self.messages(kinds):
            try:
                self._count(message, census)
            except ValueError as error:
                broken = census.broken.setdefault(message.topic, Broken(message.number, str(error)))
                broken.count += 1
        return census

    def decode(self, message: RawMessage) -> Any:
        """As in BagFile; stamps that nobody sets are 0, so the times of recording count."""
        content = super().decode(message)
        for stamped, header in _headers(message.topic, content):
            clock = self.census.clocks.get(stamped)
            if clock is not None and clock.is_unset and clock.is_recorded:
                header.stamp.sec = header.stamp.nanosec = 0
        return content

    def _count(self, message: RawMessage, census: Census) -> None:
        topic, content, now_ns = message.topic, super().decode(message), message.bag_time_ns
        clock = census.clocks.setdefault((topic, "", ""), Clock())
        if topic.type in SCANS:
            stamp, frame = header_of(content.header, now_ns)
            census.scan_frames.setdefault(topic, Counter())[frame] += 1
            clock.add(stamp, now_ns, (frame, getattr(content, "angle_min", 0.0)), message.payload[_STAMP_END:])
        elif topic.type == ODOMETRY:
            reading = odometry_of(content, now_ns)
            census.base_frames.setdefault(topic, Counter())[reading.base_frame] += 1
            clock.add(reading.stamp, now_ns, reading.base_frame, reading.T_odom_base)
        else:
            for stamp, parent, child, transform in transforms_of(content, now_ns):
                link = topic, parent, child
                census.clocks.setdefault(link, Clock()).add(stamp, now_ns, "", transform)
                seen = census.links.setdefault(link, [transform])
                if len(seen) == 1 and differ(seen[0], transform):
                    seen.append(transform)


def _headers(topic: Topic, content: Any) -> Iterator[tuple[Stamped, Any]]:
    """The headers of the stamps that are counted."""
    if is_transforms(topic):
        for each in content.transforms:
            yield (topic, frame_of(each.header.frame_id), frame_of(each.child_frame_id)), each.header
    elif topic.type in (*SCANS, ODOMETRY):
        yield (topic, "", ""), content.header
