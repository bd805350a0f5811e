"""The contents of a bag, also of one that cannot be mapped: topics with their rates, and frames."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from fcslam.sources.bags.codec import SCANS
from fcslam.sources.bags.container import BagFile, RawMessage, Topic, is_transforms
from fcslam.sources.bags.messages import header_of, transforms_of

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
    laser_frames: dict[str, str]
    """Frame of the first scan of each topic of laser scans."""


def bag_contents(path: Path) -> BagContents:
    """Read all messages once; those that cannot be decoded count as the others.

    Raises:
        SourceError: the bag cannot be read.
    """
    bag = BagFile(path)
    spans_ns: dict[Topic, tuple[int, int, int]] = {}
    edges: dict[tuple[str, str], None] = {}
    frames: dict[str, str] = {}
    for message in bag.messages(bag.topics):
        topic, now_ns = message.topic, message.bag_time_ns
        count, first_ns, last_ns = spans_ns.get(topic, (0, now_ns, now_ns))
        spans_ns[topic] = count + 1, min(first_ns, now_ns), max(last_ns, now_ns)
        if is_transforms(topic):
            edges |= dict.fromkeys(_edges(bag, message))
        elif topic.type in SCANS and topic.name not in frames:
            frames |= _frame(bag, message)
    topics = (_contents(topic, spans_ns.get(topic)) for topic in bag.topics)
    return BagContents(tuple(topics), tuple(edges), frames)


def _contents(topic: Topic, span_ns: tuple[int, int, int] | None) -> TopicContents:
    count, first_ns, last_ns = span_ns or (topic.message_count, 0, 0)
    rate_hz = (count - 1) * _NANOSECONDS / (last_ns - first_ns) if last_ns > first_ns else None
    return TopicContents(topic.name, topic.type, count, rate_hz)


def _edges(bag: BagFile, message: RawMessage) -> Iterator[tuple[str, str]]:
    try:
        for transform in transforms_of(bag.decode(message), message.bag_time_ns):
            yield transform.parent, transform.child
    except ValueError:
        return


def _frame(bag: BagFile, message: RawMessage) -> dict[str, str]:
    try:
        _, frame = header_of(bag.decode(message).header, message.bag_time_ns)
    except ValueError:
        return {}
    return {message.topic.name: frame}
