"""Records what a robot publishes into a file that `fcslam map` reads: the messages as they come, undecoded."""

import threading
import time
from collections import Counter
from collections.abc import Iterator
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

LARGEST_WAITING_BYTES = 256_000_000
"""Most bytes that wait for a slow disk."""


def record(
    network: RosNetwork, topics: SensorTopics, output: Path, stop: threading.Event, notify: Notify
) -> Counter[str]:
    """Write all messages of the sensors, and /clock, until ``stop``; returns their number by topic.

    The file moves to ``output`` at the end; if it cannot, what the disk took is kept beside it but the last megabyte.
    """
    from rosbags import rosbag2

    inbox = Inbox(LARGEST_WAITING_BYTES)
    kinds = {**topics.kinds, CLOCK_TOPIC: CLOCK}
    inbox.subscribe(network, kinds, {}, time.time_ns)
    counts: Counter[str] = Counter()
    connections: dict[str, Any] = {}
    latest_ns, kept = 0, ""
    try:
        with TemporaryDirectory(prefix=".", dir=output.parent) as staging:
            place = Path(staging, output.stem)
            writer = rosbag2.Writer(place, version=9, storage_plugin=rosbag2.StoragePlugin.MCAP)
            file = place / f"{place.name}.mcap"
            try:
                writer.open()
                for topic, payload, received_ns, _ in _messages(inbox, stop):
                    if topic not in connections:
                        name = full_name(kinds[topic])
                        connections[topic] = writer.add_connection(topic, name, typestore=typestore(ros1=False))
                    latest_ns = max(latest_ns, received_ns)  # the time of recording only ever grows
                    writer.write(connections[topic], latest_ns, payload)
                    counts[topic] += 1
                writer.close()
            except BaseException as error:
                with suppress(Exception):
                    writer.abort()
                if counts and file.exists():  # a bag that was cut off is read up to there
                    kept = f"what was recorded before is in {file.replace(_part_of(output))}"
                    if not isinstance(error, OSError):
                        notify(kept)
                raise
            file.replace(output)
    except OSError as error:
        advice = "; ".join(filter(None, (kept, "free some space, or choose another path")))
        raise InputError(f"{output}: cannot be written ({error}); {advice}") from error
    for topic in (*topics.scans, *filter(None, (topics.odometry,))):
        if not counts[topic]:
            notify(f"{topic}: no message arrived")
    if inbox.lost:
        notify(f"the disk is slower than the messages: {inbox.lost} were lost; record fewer topics, or on another disk")
    return counts


def _messages(inbox: Inbox, stop: threading.Event) -> Iterator[ReceivedMessage]:
    """The messages until ``stop``, and those that wait then: others keep coming."""
    while not stop.is_set():
        if (message := inbox.get(POLL_S)) is not None:
            yield message
    for _ in range(len(inbox)):
        if (message := inbox.get(0.0)) is not None:
            yield message


def _part_of(output: Path) -> Path:
    """The first name that is free for a part of ``output``, as in ``day.part.mcap``."""
    parts = (f"part-{number}" if number > 1 else "part" for number in count(1))
    places = (output.with_name(f"{output.stem}.{part}{output.suffix}") for part in parts)
    return next(place for place in places if not place.exists())
