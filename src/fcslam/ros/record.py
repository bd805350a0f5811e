"""Records what a robot publishes into a file that `fcslam map` reads: the messages as they come, undecoded."""

import threading
import time
from collections import Counter
from contextlib import suppress
from itertools import count
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from fcslam.errors import InputError
from fcslam.ros.clock import CLOCK, CLOCK_TOPIC
from fcslam.ros.inbox import POLL_S, Inbox, ReceivedMessage
from fcslam.ros.live_plan import Notify
from fcslam.ros.network import RosNetwork
from fcslam.ros.topics import SensorTopics
from fcslam.sources.bags.codec import full_name, typestore


def record(
    network: RosNetwork,
    topics: SensorTopics,
    output: Path,
    stop: threading.Event,
    notify: Notify,
) -> Counter[str]:
    """Write all messages of the sensors, and /clock, until ``stop``; returns their number by topic.

    The file moves to ``output`` at the end. If it cannot be written to the end, what the disk took is kept beside it,
    but for the last megabyte.
    """
    inbox = Inbox()
    kinds = {**topics.kinds, CLOCK_TOPIC: CLOCK}
    inbox.subscribe(network, kinds, {}, time.time_ns)
    counts: Counter[str] = Counter()
    kept = ""
    try:
        with TemporaryDirectory(prefix=".", dir=output.parent) as staging:
            recording = _Recording(Path(staging, output.stem))
            try:
                recording.writer.open()
                while (message := inbox.get(POLL_S)) is not None or not stop.is_set():
                    if message is not None:
                        recording.write(message, kinds[message.topic])
                        counts[message.topic] += 1
                recording.writer.close()
            except BaseException as error:
                with suppress(Exception):
                    recording.writer.abort()
                if counts and recording.file.exists():  # a bag that was cut off is read up to there
                    kept = f"what was recorded before is in {recording.file.replace(_part_of(output))}"
                    if not isinstance(error, OSError):
                        notify(kept)
                raise
            recording.file.replace(output)
    except OSError as error:
        advice = "; ".join(filter(None, (kept, "free some space, or choose another path")))
        raise InputError(f"{output}: cannot be written ({error}); {advice}") from error
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


class _Recording:
    def __init__(self, place: Path) -> None:
        from rosbags import rosbag2

        self._store = typestore(ros1=False)
        self._connections: dict[str, Any] = {}
        self._latest_ns = 0
        self.writer = rosbag2.Writer(place, version=9, storage_plugin=rosbag2.StoragePlugin.MCAP)
        self.file = place / f"{place.name}.mcap"

    def write(self, message: ReceivedMessage, kind: str) -> None:
        """Write a message; the time of recording only ever grows."""
        topic, payload, received_ns = message
        if topic not in self._connections:
            self._connections[topic] = self.writer.add_connection(topic, full_name(kind), typestore=self._store)
        self._latest_ns = max(self._latest_ns, received_ns)
        self.writer.write(self._connections[topic], self._latest_ns, payload)
