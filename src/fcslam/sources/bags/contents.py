"""The contents of a bag, also of one that cannot be mapped: topics with their rates, and frames."""

from dataclasses import dataclass

from fcslam.sources.bags.census import CountedBag
from fcslam.sources.bags.container import Topic

_NANOSECONDS = 1e9


@dataclass(frozen=True, slots=True)
class TopicContents:
    """One topic of a bag."""

    name: str
    type: str
    messages: int
    rate_hz: float | None
    """Mean, by the times of recording; None with fewer than two messages or without time between them."""


@dataclass(frozen=True, slots=True)
class BagContents:
    """The topics and frames of a bag."""

    topics: tuple[TopicContents, ...]
    """Sorted by name."""
    transforms: tuple[tuple[str, str], ...]
    """Parent and child of the transforms in tf, in the order in which they appear."""
    laser_frames: dict[str, tuple[str, ...]]
    """Frames of the scans on each topic of laser scans."""


def bag_contents(bag: CountedBag) -> BagContents:
    """Read all messages once; those that cannot be decoded count as the others.

    Raises:
        SourceError: the bag cannot be read.
    """
    spans_ns: dict[Topic, tuple[int, int, int]] = {}
    for message in bag.messages(bag.topics):
        topic, now_ns = message.topic, message.bag_time_ns
        count, first_ns, last_ns = spans_ns.get(topic, (0, now_ns, now_ns))
        spans_ns[topic] = count + 1, min(first_ns, now_ns), max(last_ns, now_ns)
    topics = (_contents(topic, spans_ns.get(topic)) for topic in bag.topics)
    edges = dict.fromkeys((parent, child) for _, parent, child in bag.census.links)
    frames = {topic.name: tuple(seen) for topic, seen in bag.census.scan_frames.items()}
    return BagContents(tuple(topics), tuple(edges), frames)


def _contents(topic: Topic, span_ns: tuple[int, int, int] | None) -> TopicContents:
    count, first_ns, last_ns = span_ns or (topic.message_count, 0, 0)
    rate_hz = (count - 1) * _NANOSECONDS / (last_ns - first_ns) if last_ns > first_ns else None
    return TopicContents(topic.name, topic.type, count, rate_hz)
