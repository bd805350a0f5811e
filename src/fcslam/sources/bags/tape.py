"""Decoded messages of a bag in a temporary file, in the order of recording, so that a bag is decoded once."""

import json
import os
from array import array
from collections.abc import Collection, Iterator
from tempfile import TemporaryFile
from weakref import finalize

import numpy as np

from fcslam.records import Beams, Sweep, Transform
from fcslam.sources.bags.messages import BeamsError, OdometryReading, ScanMessage, StampedTransform

Content = ScanMessage | OdometryReading | list[StampedTransform] | ValueError
"""A decoded message, or why it is invalid."""


class Tape:
    """Messages in the order in which they are added. Any thread, and any copy of the process, may read them."""

    def __init__(self) -> None:
        self._file = TemporaryFile(prefix="fcslam-")  # noqa: SIM115  it lives as long as the tape
        finalize(self, self._file.close)
        self._topics, self._ends = array("L"), array("q")
        self._times_ns: list[int] = []
        """Of a damaged bag, some are larger than a 64-bit integer."""
        self._size = 0

    def add(self, topic: int, time_ns: int, content: Content) -> None:
        """Add the next message of a topic, with its time of recording; raises OSError if the disk is full."""
        self._size += self._file.write(_packed(content))
        self._topics.append(topic)
        self._times_ns.append(time_ns)
        self._ends.append(self._size)

    def finish(self) -> None:
        """Make what was added readable; raises OSError if the disk is full."""
        self._file.flush()

    def read(self, topics: Collection[int]) -> Iterator[tuple[int, int, Content]]:
        """The messages of some topics: topic, time of recording and content."""
        begin = 0
        for topic, time_ns, end in zip(self._topics, self._times_ns, self._ends, strict=True):
            if topic in topics:
                yield topic, time_ns, _unpacked(os.pread(self._file.fileno(), end - begin, begin))
            begin = end


def _packed(content: Content) -> bytes:
    if isinstance(content, ScanMessage):
        fields = json.dumps(("scan", *content._replace(raw_ranges_m=None)))  # type: ignore[arg-type]
        return fields.encode() + b"\n" + content.raw_ranges_m.tobytes()
    if isinstance(content, ValueError):
        return json.dumps((type(content).__name__, str(content))).encode()
    kind = "odometry" if isinstance(content, OdometryReading) else "transforms"
    return json.dumps((kind, *content)).encode()


def _unpacked(packed: bytes) -> Content:
    text, _, ranges = packed.partition(b"\n")
    kind, *fields = json.loads(text)
    if kind == "scan":
        stamp, frame, beams, low_m, high_m, _, laser, sweep, _ = fields
        raw_ranges_m = np.frombuffer(ranges, np.float32)
        return ScanMessage(
            stamp, frame, Beams(*beams), low_m, high_m, raw_ranges_m, laser, sweep and Sweep(sweep[0], sweep[1])
        )
    if kind == "odometry":
        stamp, pose, *frames = fields
        return OdometryReading(stamp, tuple(pose), *frames)
    if kind == "transforms":
        return [
            StampedTransform(stamp, parent, child, Transform(tuple(at), tuple(turn)))
            for stamp, parent, child, (at, turn) in fields
        ]
    return (BeamsError if kind == BeamsError.__name__ else ValueError)(*fields)
