"""Messages of a robot's sensors that wait to be read."""

import queue
import threading
import time
from collections.abc import Callable, Mapping
from functools import partial
from typing import Final, NamedTuple

from fcslam.ros.network import Quality, RosNetwork
from fcslam.ros.topics import TF_STATIC
from fcslam.sources.bags.codec import TRANSFORMS
from fcslam.sources.bags.transforms import last_part

POLL_S: Final = 0.1
"""How long whoever reads an inbox waits for a message."""
LARGEST_INBOX_BYTES: Final = 64_000_000
"""Most bytes that wait; beyond, the next messages are lost."""
SILENCE_S: Final = 2.0
"""A longer pause of scans is reported; after it, another publisher of a topic may take the place of the first one."""
_DEPTH: Final = 1000
"""Messages that the middleware keeps for this process; of odometry and tf there are many."""


class ReceivedMessage(NamedTuple):
    """A message as it came."""

    topic: str
    payload: bytes
    received_ns: int
    """By the clock of ROS."""
    arrived_s: float
    """By a clock that only grows, however long the message then waited to be read."""


class Inbox:
    """Subscribes to topics, and keeps their messages until they are read. Any thread may deliver.

    Of a sensor's topic, the messages of one publisher count: a stranger on the network cannot mix scans of its own in.
    """

    def __init__(
        self,
        most_bytes: int = LARGEST_INBOX_BYTES,
        notify: Callable[[str], object] = lambda _: None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.lost = 0
        """Messages that came while too many bytes waited."""
        self._most_bytes, self._notify, self._clock = most_bytes, notify, clock
        self._publishers: dict[str, tuple[str, float]] = {}
        """By topic, the publisher that counts, and when it was heard last."""
        self._shared: set[str] = set()
        """Topics with a second publisher, of which there was a line."""
        self._messages: queue.SimpleQueue[ReceivedMessage] = queue.SimpleQueue()
        self._waiting_bytes = 0
        self._lock = threading.Lock()

    def subscribe(
        self, network: RosNetwork, kinds: Mapping[str, str], depths: Mapping[str, int], now_ns: Callable[[], int]
    ) -> None:
        """Subscribe to topics of these types; ``depths`` are those of types of which few messages shall wait."""
        offered = [point for point in network.endpoints() if point.publishes]
        for topic, kind in kinds.items():
            # Ask for reliable messages where all publishers offer them: then none is lost.
            reliable = [point.quality.reliable for point in offered if point.topic == topic]
            latched = last_part(topic) == TF_STATIC
            quality = Quality((bool(reliable) and all(reliable)) or latched, latched, depths.get(kind, _DEPTH))
            deliver = self._deliver if kind == TRANSFORMS else self._deliver_first  # tf has many publishers
            network.subscribe(topic, kind, quality, partial(deliver, topic, now_ns))

    def _deliver_first(self, topic: str, now_ns: Callable[[], int], payload: bytes, publisher: str) -> None:
        now_s = self._clock()
        first, heard_s = self._publishers.get(topic, (publisher, now_s))
        if publisher == first or now_s > heard_s + SILENCE_S:
            self._publishers[topic] = publisher, now_s
            self._deliver(topic, now_ns, payload, publisher)
        elif topic not in self._shared:
            self._shared.add(topic)
            self._notify(
                f"{topic} has two publishers, {first} and {publisher}; the messages of the second one are left out; "
                f"find it by `ros2 topic info -v {topic}`"
            )

    def _deliver(self, topic: str, now_ns: Callable[[], int], payload: bytes, _publisher: str) -> None:
        with self._lock:
            is_lost = self._waiting_bytes + len(payload) > self._most_bytes
            self.lost += is_lost
            self._waiting_bytes += 0 if is_lost else len(payload)
        if is_lost:
            self._notify("messages come faster than this computer can map; some are lost")
        else:
            self._messages.put(ReceivedMessage(topic, payload, now_ns(), self._clock()))

    def __len__(self) -> int:
        """Number of messages that wait."""
        return self._messages.qsize()

    def get(self, timeout_s: float) -> ReceivedMessage | None:
        """The next message; None if none came within the time."""
        try:
            message = self._messages.get(timeout=timeout_s)
        except queue.Empty:
            return None
        with self._lock:
            self._waiting_bytes -= len(message.payload)
        return message
