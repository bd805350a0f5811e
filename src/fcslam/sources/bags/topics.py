"""Which topics of a bag are read: those that the user named, or a choice by clear rules, which is told."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

from fcslam.errors import SourceError
from fcslam.sources.bags.container import ODOMETRY, SCAN, BagFile, Topic, is_transforms
from fcslam.sources.bags.options import BagOptions

_NAMED_AT_MOST = 15


class Topics(NamedTuple):
    """What is read of a bag."""

    scan: Topic
    odometry: tuple[Topic, ...]
    """One of odometry, or those that carry tf."""
    transforms: tuple[Topic, ...]
    """All that carry tf."""
    notes: tuple[str, ...]


def choose_topics(bag: BagFile, options: BagOptions, field_of_view: Callable[[Topic], float]) -> Topics:
    """The topics to read.

    Of several lasers the one with the widest ``field_of_view`` (radians), then with most messages, then the first by
    name. Of several odometries one that is called ``odom``, then with most messages, then the first by name.

    Raises:
        SourceError: there is no such topic, or one named is not there or of another type.
    """
    heard = [topic for topic in bag.topics if topic.message_count]
    scans = _candidates(bag, options.scan_topic, "--scan-topic", [topic for topic in heard if topic.type == SCAN], SCAN)
    if not scans:
        raise SourceError(f"{bag.path}: no laser scans ({SCAN}); record them; {_known(bag.topics)}")
    transforms = [topic for topic in heard if is_transforms(topic)]
    measured = [topic for topic in heard if topic.type == ODOMETRY]
    expected = f"{ODOMETRY}, or tf"
    odometries = _candidates(bag, options.odom_topic, "--odom-topic", [*measured, *transforms], expected)
    odometries = [topic for topic in odometries if topic.type == ODOMETRY] or odometries
    if not odometries:
        raise SourceError(
            f"{bag.path}: no odometry ({ODOMETRY}, or tf from odom to base); record it; {_known(bag.topics)}"
        )
    views = {topic: field_of_view(topic) if len(scans) > 1 else 0.0 for topic in scans}
    scan = min(scans, key=lambda topic: (-views[topic], -topic.message_count, topic.name))
    odometry = min(odometries, key=lambda topic: (_basename(topic) != "odom", -topic.message_count, topic.name))
    notes = _note(bag, "laser scans", "--scan-topic", scan, scans)
    if is_transforms(odometry):
        return Topics(scan, tuple(odometries), tuple(transforms), tuple(notes))
    notes += _note(bag, "odometry", "--odom-topic", odometry, odometries)
    return Topics(scan, (odometry,), tuple(transforms), tuple(notes))


def _candidates(
    bag: BagFile, wanted: str | None, option: str, candidates: Sequence[Topic], expected: str
) -> list[Topic]:
    """The candidates, or the one of them that the user wants."""
    if wanted is None:
        return list(candidates)
    chosen = [topic for topic in candidates if _slashed(topic.name) == _slashed(wanted)]
    if chosen:
        return chosen[:1]
    there = [topic for topic in bag.topics if _slashed(topic.name) == _slashed(wanted)]
    what = f"carries {there[0].type} in {there[0].message_count} messages, not {expected}" if there else "is not there"
    raise SourceError(f"{bag.path}: topic {wanted} {what}; choose another by {option}; {_known(bag.topics)}")


def _note(bag: BagFile, what: str, option: str, chosen: Topic, candidates: Sequence[Topic]) -> list[str]:
    others = ", ".join(topic.name for topic in candidates if topic != chosen)
    return [f"{bag.path}: reads {what} from {chosen.name}, not from {others} ({option} chooses)"] if others else []


def _known(topics: Sequence[Topic]) -> str:
    if not topics:
        return "the bag has no topics"
    named = ", ".join(f"{topic.name} ({topic.type}, {topic.message_count})" for topic in topics[:_NAMED_AT_MOST])
    more = f" and {len(topics) - _NAMED_AT_MOST} more" if len(topics) > _NAMED_AT_MOST else ""
    return f"the topics are {named}{more}"


def _slashed(name: str) -> str:
    return "/" + name.strip("/")


def _basename(topic: Topic) -> str:
    return topic.name.rsplit("/", 1)[-1]
