"""Decoded messages of a bag as bytes, so that a bag is decoded once."""

import json

import numpy as np

from fcslam.records import Beams, Sweep, Transform
from fcslam.sources.bags.messages import BeamsError, OdometryReading, ScanMessage, StampedTransform

Content = ScanMessage | OdometryReading | list[StampedTransform] | ValueError
"""A decoded message, or why it is invalid."""


def packed_content(content: Content) -> bytes:
    """The message as bytes."""
    if isinstance(content, ScanMessage):
        fields = json.dumps(("scan", *content._replace(raw_ranges_m=None)))  # type: ignore[arg-type]
        return fields.encode() + b"\n" + content.raw_ranges_m.tobytes()
    if isinstance(content, ValueError):
        return json.dumps((type(content).__name__, str(content))).encode()
    kind = "odometry" if isinstance(content, OdometryReading) else "transforms"
    return json.dumps((kind, *content)).encode()


def unpacked_content(packed: bytes) -> Content:
    """The message of ``packed_content``."""
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
