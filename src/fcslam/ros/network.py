"""The interface of a ROS network, whatever carries the messages.

Messages are bytes here; ``sources.bags.codec`` decodes them, as for bags.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple, Protocol

MOST_ENDPOINTS = 10_000
"""Most endpoints of a network that are remembered."""

Deliver = Callable[[bytes, str], object]
"""Called with the bytes of each message and the id of its publisher, in a thread of the network."""
Publish = Callable[[bytes], None]
"""Sends the bytes of one message. Any thread may call it."""


class Quality(NamedTuple):
    """Quality of service of a publisher or a subscription."""

    reliable: bool
    """Lost messages are sent again."""
    latched: bool = False
    """A late subscriber gets the last messages (transient local)."""
    depth: int = 10


class Endpoint(NamedTuple):
    """A publisher or a subscription in the network."""

    topic: str
    """With a leading slash."""
    kind: str
    publishes: bool
    quality: Quality
    own: bool = False
    """Whether it belongs to this process."""


class RosNetwork(Protocol):
    """A connection to a ROS network."""

    def endpoints(self) -> Sequence[Endpoint]:
        """The publishers and subscriptions that are known now."""

    def subscribe(self, topic: str, kind: str, quality: Quality, deliver: Deliver) -> None:
        """Deliver the messages of a topic from now on."""

    def publisher(self, topic: str, kind: str, quality: Quality) -> Publish:
        """Begin to publish a topic."""

    def close(self) -> None:
        """Leave the network; nothing is delivered afterwards."""


def published(endpoints: Sequence[Endpoint]) -> dict[str, str]:
    """The topics that others publish, with their types, in the order of their names."""
    return {point.topic: point.kind for point in sorted(endpoints) if point.publishes and not point.own}
