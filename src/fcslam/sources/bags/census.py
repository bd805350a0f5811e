"""The frames in a bag: of its scans, of its odometry and in tf, from one pass over it."""

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field
from functools import cached_property

from fcslam.records import Transform
from fcslam.sources.bags.codec import ODOMETRY, SCANS
from fcslam.sources.bags.container import BagFile, RawMessage, Topic, is_transforms
from fcslam.sources.bags.messages import header_of, odometry_of, transforms_of
from fcslam.sources.bags.transforms import TransformTree, differ


@dataclass(slots=True)
class Broken:
    """The messages of a topic that are invalid."""

    first: int
    """Number of the first one in its topic, from 1."""
    error: str
    """Its fault."""
    count: int = 0


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

    def _count(self, message: RawMessage, census: Census) -> None:
        topic, content = message.topic, self.decode(message)
        if topic.type in SCANS:
            _, frame = header_of(content.header, message.bag_time_ns)
            census.scan_frames.setdefault(topic, Counter())[frame] += 1
        elif topic.type == ODOMETRY:
            base_frame = odometry_of(content, message.bag_time_ns).base_frame
            census.base_frames.setdefault(topic, Counter())[base_frame] += 1
        else:
            for _, parent, child, transform in transforms_of(content, message.bag_time_ns):
                seen = census.links.setdefault((topic, parent, child), [transform])
                if len(seen) == 1 and differ(seen[0], transform):
                    seen.append(transform)
