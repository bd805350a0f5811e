"""Records what a robot publishes into a file that `fcslam map` reads: the messages as they come, undecoded."""

import queue
import threading
import time
from collections import Counter
from contextlib import suppress
from itertools import count
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from fcslam.errors import OutputError
from fcslam.ros.clock import CLOCK, CLOCK_TOPIC
from fcslam.ros.network import Quality, RosNetwork
from fcslam.ros.sensors import Notify
from fcslam.ros.topics import TF_STATIC, SensorTopics
from fcslam.sources.bags.codec import full_name, typestore
from fcslam.sources.bags.mcap_records import end_mcap
from fcslam.sources.bags.transforms import last_part

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
) -> Counter[str]:
    """Write all messages of the sensors, and /clock, until ``stop``; returns their number by topic.

    The file moves to ``output`` at the end. If it cannot be written to the end, what the disk took is kept beside it.

    Raises:
        OutputError: the file cannot be written; the message names the file that is kept.
    """
    inbox = _Inbox()
    kinds = {**topics.kinds, CLOCK_TOPIC: CLOCK}
    offered = [point for point in network.endpoints() if point.publishes]
    for topic, kind in kinds.items():
        reliable = [point.quality.reliable for point in offered if point.topic == topic]
        latched = last_part(topic) == TF_STATIC
        quality = Quality((bool(reliable) and all(reliable)) or latched, latched, _DEPTH)

        def deliver(payload: bytes, topic: str = topic) -> None:
            inbox.put(topic, time.time_ns(), payload)

        network.subscribe(topic, kind, quality, deliver)
    counts: Counter[str] = Counter()
    kept = ""
    try:
        with TemporaryDirectory(prefix=".", dir=output.parent) as staging:
            recording = _Recording(Path(staging, output.stem))
            try:
                recording.writer.open()
                while not stop.is_set() or not inbox.is_empty:
                    try:
                        topic, received_ns, payload = inbox.get(_POLL_S)
                    except queue.Empty:
                        continue
                    recording.write(topic, kinds[topic], received_ns, payload)
                    counts[topic] += 1
                recording.writer.close()
            except BaseException as error:
                if recording.rescue(error):
                    kept = f"what was recorded before is in {recording.file.replace(_part_of(output))}"
                    if not isinstance(error, OSError):
                        notify(kept)
                raise
            recording.file.replace(output)
    except OSError as error:
        advice = "; ".join(filter(None, (kept, "free some space, or choose another path")))
        raise OutputError(f"{output}: cannot be written ({error}); {advice}") from error
    for topic in (*topics.scans, *filter(None, (topics.odometry,))):
        if not counts[topic]:
            notify(f"{topic}: no message arrived")
    if inbox.lost:
        notify(f"the disk is slower than the messages: {inbox.lost} were lost; record fewer topics, or on another disk")
    return counts


def _part_of(output: Path) -> Path:
    """The first name that is free for a part of ``output``, as in ``day.part.mcap``."""
    parts = (f"part-{number}" if number > 1 else "part" for number in count(1))
    places = (output.with_name(f"{output.stem}.{part}{output.suffix}") for part in parts)
    return next(place for place in places if not place.exists())


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
        """The next message."""
        message = self._messages.get(timeout=timeout_s)
        with self._lock:
            self._waiting_bytes -= len(message[2])
        return message


class _Recording:
    """A bag (MCAP) of raw messages."""

    def __init__(self, place: Path) -> None:
        from rosbags import rosbag2

        self._store = typestore(ros1=False)
        self._connections: dict[str, Any] = {}
        self._latest_ns = 0
        self.writer = rosbag2.Writer(place, version=9, storage_plugin=rosbag2.StoragePlugin.MCAP)
        self.file = place / f"{place.name}.mcap"

    def rescue(self, error: BaseException) -> bool:
        """End the file after an error, and return whether it holds messages.

        After an error of the disk, the last megabyte is lost.
        """
        if not isinstance(error, OSError):
            with suppress(Exception):
                self.writer.close()
                return bool(self._connections)
        with suppress(Exception):
            self.writer.abort()
        try:
            return end_mcap(self.file)
        except OSError:
            return self.file.exists()

    def write(self, topic: str, kind: str, received_ns: int, payload: bytes) -> None:
        """Write a message; the time of recording only ever grows."""
        if topic not in self._connections:
            self._connections[topic] = self.writer.add_connection(topic, full_name(kind), typestore=self._store)
        self._latest_ns = max(self._latest_ns, received_ns)
        self.writer.write(self._connections[topic], self._latest_ns, payload)
