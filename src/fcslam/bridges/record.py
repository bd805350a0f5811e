"""Records what a robot publishes into a file that `fcslam map` reads: the messages as they come, undecoded."""

import queue
import threading
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from fcslam.bridges.clock import CLOCK, CLOCK_TOPIC
from fcslam.bridges.network import Quality, RosNetwork
from fcslam.bridges.sensors import Notify
from fcslam.bridges.topics import TF_STATIC, SensorTopics
from fcslam.errors import OutputError
from fcslam.sources.bags.codec import full_name, typestore

_POLL_S = 0.2
_DEPTH = 1000
LARGEST_INBOX_BYTES = 256_000_000
"""Most bytes that wait for the disk; beyond, the next messages are lost."""


def record(
    network: RosNetwork,
    topics: SensorTopics,
    output: Path,
    stop: threading.Event,
    notify: Notify,
    watch: Callable[[Counter[str]], None] = lambda _: None,
) -> Counter[str]:
    """Write all messages of the sensors, and /clock, until ``stop``; returns their number by topic.

    The file is complete or absent: it moves to ``output`` at the end.

    Raises:
        OutputError: the file cannot be written.
    """
    inbox = _Inbox()
    kinds = {**topics.kinds, CLOCK_TOPIC: CLOCK}

    def subscribe(topic: str, kind: str, reliable: bool) -> None:
        latched = topic.rsplit("/", 1)[-1] == TF_STATIC
        quality = Quality(reliable or latched, latched, _DEPTH)
        network.subscribe(topic, kind, quality, lambda payload: inbox.put(topic, time.time_ns(), payload))

    offered = [point for point in network.endpoints() if point.publishes]
    for topic, kind in kinds.items():
        publishers = [point for point in offered if point.topic == topic]
        subscribe(topic, kind, bool(publishers) and all(point.quality.reliable for point in publishers))
    counts: Counter[str] = Counter()
    try:
        with TemporaryDirectory(prefix=".", dir=output.parent) as staging:
            with _Recording(Path(staging, output.stem), network.ros1) as recording:
                while not stop.is_set() or not inbox.is_empty:
                    try:
                        topic, received_ns, payload = inbox.get(_POLL_S)
                    except queue.Empty:
                        continue
                    recording.write(topic, kinds[topic], received_ns, payload)
                    counts[topic] += 1
                    watch(counts)
            recording.file.replace(output)
    except OSError as error:
        raise OutputError(f"{output}: cannot be written ({error}); free some space, or choose another path") from error
    for topic in (*topics.scans, *filter(None, (topics.odometry,))):
        if not counts[topic]:
            notify(f"{topic}: no message arrived")
    if inbox.lost:
        notify(f"the disk is slower than the messages: {inbox.lost} were lost; record fewer topics, or on another disk")
    return counts


class _Inbox:
    """Messages that wait for the disk. Any thread may put."""

    def __init__(self) -> None:
        self.lost = 0
        """Messages that came while too many bytes waited."""
        self._messages: queue.SimpleQueue[tuple[str, int, bytes]] = queue.SimpleQueue()
        self._waiting_bytes = 0
        self._lock = threading.Lock()

    @property
    def is_empty(self) -> bool:
        """Whether no message waits."""
        return self._messages.empty()

    def put(self, topic: str, received_ns: int, payload: bytes) -> None:
        """Add the next message, or lose it if too much waits."""
        with self._lock:
            if self._waiting_bytes + len(payload) > LARGEST_INBOX_BYTES:
                self.lost += 1
                return
            self._waiting_bytes += len(payload)
        self._messages.put((topic, received_ns, payload))

    def get(self, timeout_s: float) -> tuple[str, int, bytes]:
        """The next message.

        Raises:
            queue.Empty: none came within the time.
        """
        message = self._messages.get(timeout=timeout_s)
        with self._lock:
            self._waiting_bytes -= len(message[2])
        return message


class _Recording:
    """A bag of raw messages: MCAP of ROS 2, or a bag of ROS 1."""

    def __init__(self, place: Path, ros1: bool) -> None:
        from rosbags import rosbag1, rosbag2

        self._store = typestore(ros1)
        self._connections: dict[str, Any] = {}
        self._latest_ns = 0
        self._writer: Any
        if ros1:
            self._writer = rosbag1.Writer(place)
            self.file = place
        else:
            self._writer = rosbag2.Writer(place, version=9, storage_plugin=rosbag2.StoragePlugin.MCAP)
            self.file = place / f"{place.name}.mcap"

    def __enter__(self) -> "_Recording":
        self._writer.open()
        return self

    def __exit__(self, *_: object) -> None:
        self._writer.close()

    def write(self, topic: str, kind: str, received_ns: int, payload: bytes) -> None:
        """Write a message; the time of recording only ever grows."""
        if topic not in self._connections:
            self._connections[topic] = self._writer.add_connection(topic, full_name(kind), typestore=self._store)
        self._latest_ns = max(self._latest_ns, received_ns)
        self._writer.write(self._connections[topic], self._latest_ns, payload)
