"""Which topics of a bag are read: those that the user named, or a choice by clear rules, which is told."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

from fcslam.errors import SourceError
from fcslam.sources.bags.container import ODOMETRY, SCAN, BagFile, Topic, is_transforms
from fcslam.sources.bags.options import BagOptions

_NAMED_AT_MOST = 15
_NEEDED = {"--scan-topic": SCAN, "--odom-topic": f"{ODOMETRY}, or tf"}


class Topics(NamedTuple):
    """What is read of a bag."""

    scan: Topic
    odometry: tuple[Topic, ...]
    """One of odometry, or those that carry tf."""
    transforms: tuple[Topic, ...]
    """All that carry tf."""
    notes: tuple[str, ...]


def choose_topics(bag: BagFile, options: BagOptions, field_of_view_rad: Callable[[Topic], float]) -> Topics:
    """The topics to read.

    Of several lasers the one with the widest field of view, to 0.01 rad, then with most messages, then the first by
    name. Of several odometries one that is called ``odom``, then with most messages, then the first by name.

    Raises:
        SourceError: there is no such topic, or one named is not there or of another type.
    """
    heard = [topic for topic in bag.topics if topic.message_count]
    scans = _candidates(bag, [topic for topic in heard if topic.type == SCAN], options.scan_topic, "--scan-topic")
    if not scans:
        raise SourceError(f"{bag.path}: no laser scans ({SCAN}); record them; {_known(bag.topics)}")
    transforms = tuple(topic for topic in heard if is_transforms(topic))
    measured = [topic for topic in heard if topic.type == ODOMETRY]
    odometries = _candidates(bag, [*measured, *transforms], options.odom_topic, "--odom-topic")
    if not odometries:
        raise SourceError(
            f"{bag.path}: no odometry ({ODOMETRY}, or tf from odom to base); record it; {_known(bag.topics)}"
        )
    views_rad = {topic: round(field_of_view_rad(topic), 2) if len(scans) > 1 else 0.0 for topic in scans}
    scan = min(scans, key=lambda topic: (-views_rad[topic], -topic.message_count, topic.name))
    notes = _note(bag, "laser scans", "--scan-topic", scan, scans)
    measured = [topic for topic in odometries if topic.type == ODOMETRY]
    if not measured:
        return Topics(scan, tuple(odometries), transforms, tuple(notes))
    odometry = min(measured, key=lambda topic: (_basename(topic) != "odom", -topic.message_count, topic.name))
    notes += _note(bag, "odometry", "--odom-topic", odometry, measured)
    return Topics(scan, (odometry,), transforms, tuple(notes))


def _candidates(bag: BagFile, candidates: Sequence[Topic], wanted: str | None, option: str) -> list[Topic]:
    """The candidates, or the one of them that the user wants."""
    if wanted is None:
        return list(candidates)
    chosen = [topic for topic in candidates if _slashed(topic.name) == _slashed(wanted)]
    if not chosen:
        there = [topic for topic in bag.topics if _slashed(topic.name) == _slashed(wanted)]
        what = f"has {there[0].message_count} messages of type {there[0].type}" if there else "is not there"
        raise SourceError(f"{bag.path}: topic {wanted} {what}; {option} needs {_NEEDED[option]}; {_known(bag.topics)}")
    return chosen[:1]


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
