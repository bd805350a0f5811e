"""Messages of a robot's sensors that wait to be read."""

import queue
import threading
from collections.abc import Callable, Mapping
from functools import partial
from typing import Final, NamedTuple

from fcslam.ros.network import Quality, RosNetwork
from fcslam.ros.topics import TF_STATIC
from fcslam.sources.bags.transforms import last_part

POLL_S: Final = 0.1
"""How long whoever reads an inbox waits for a message."""
LARGEST_INBOX_BYTES: Final = 64_000_000
"""Most bytes that wait; beyond, the next messages are lost."""
_DEPTH: Final = 1000
"""Messages that the middleware keeps for this process; of odometry and tf there are many."""


class ReceivedMessage(NamedTuple):
    """A message as it came."""

    topic: str
    payload: bytes
    received_ns: int


class Inbox:
    """Subscribes to topics, and keeps their messages until they are read. Any thread may deliver."""

    def __init__(self, most_bytes: int = LARGEST_INBOX_BYTES, report_loss: Callable[[], object] = lambda: None) -> None:
        self.lost = 0
        """Messages that came while too many bytes waited."""
        self._most_bytes, self._report_loss = most_bytes, report_loss
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
            network.subscribe(topic, kind, quality, partial(self._deliver, topic, now_ns))

    def _deliver(self, topic: str, now_ns: Callable[[], int], payload: bytes) -> None:
        with self._lock:
            is_lost = self._waiting_bytes + len(payload) > self._most_bytes
            self.lost += is_lost
            self._waiting_bytes += 0 if is_lost else len(payload)
        if is_lost:
            self._report_loss()
        else:
            self._messages.put(ReceivedMessage(topic, payload, now_ns()))

    def get(self, timeout_s: float) -> ReceivedMessage | None:
        """The next message; None if none came within the time."""
        try:
            message = self._messages.get(timeout=timeout_s)
        except queue.Empty:
            return None
        with self._lock:
            self._waiting_bytes -= len(message.payload)
        return message
