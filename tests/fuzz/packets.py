"""Broken packets: valid ones of every kind, and the ways to break them."""

import random
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from google.protobuf.message import DecodeError, Message

from fcslam.records import (
    PLACE_CHANNELS,
    Beams,
    Channel,
    Constraint,
    ConstraintKind,
    Correction,
    DetectorFile,
    Keyscan,
    KeyscanFix,
    KeyscanId,
    LaserModel,
    Place,
    Tag,
    TagFamily,
    TagSighting,
)
from fcslam.wire import fcslam_pb2 as pb
from fcslam.wire.limits import KEYPOINT_AXES, MAXIMUM_BEAMS, MAXIMUM_KEYPOINTS
from fcslam.wire.messages import Acknowledgement, DetectorUpdate, Hello, Packet
from fcslam.wire.packets import encode
from fcslam.wire.quantisation import dequantise
from tests.fuzz.mutations import mutate

GOLDEN = Path(__file__).parents[1] / "wire" / "golden"
SIZES = {1: 100, 3: 100, 10: 50, 30: 20, 100: 5, 300: 1, MAXIMUM_KEYPOINTS: 1}
"""Of packets, and how often one is taken: the larger the rarer."""
INTERESTING = (0, 1, 2, 3, 127, 128, 255, 2**15, 2**16, 2**31 - 1, 2**31, 2**32 - 1, 2**63 - 1, 2**63, 2**64 - 1)
FLOATS = (0.0, -0.0, 1.0, -1.0, float("nan"), float("inf"), float("-inf"), 5e-324, 1e-30, 3.2, 1e6, 1.1e6, 1e30, 1e308)


def packets_of_every_kind(rng: random.Random) -> Iterator[bytes]:
    """The golden packets several times, and random valid ones from small to the limits."""
    for path in sorted(GOLDEN.glob("*.bin")):
        yield from [path.read_bytes()] * 100
    numbers = np.random.default_rng(rng.getrandbits(64))
    for size, copies in SIZES.items():
        for body in bodies(numbers, size):
            yield from [encode(Packet("alice", 7, rng.getrandbits(40), 2e9, body))] * copies


def bodies(rng: np.random.Generator, size: int) -> Iterator[Any]:
    laser = LaserModel(min(size, MAXIMUM_BEAMS), -3.0, 0.001, 30.0, (0.1, 0.0, 0.2))
    yield Hello("alice", 7, (laser,), {Channel.LIDAR: "birdseye-brief-1", Channel.CAMERA: "light-1"})
    walk = np.abs(np.cumsum(rng.integers(-40, 41, 2 * size)))[: min(2 * size, MAXIMUM_BEAMS)]
    yield Keyscan(KeyscanId("alice", size), 1e9, dequantise((walk % 65536).astype(np.uint16)))
    yield Keyscan(KeyscanId("alice", size), 1e9, dequantise(rng.integers(0, 65536, size).astype(np.uint16)))
    beams = Beams(size, -3.0, 0.0009)
    yield Keyscan(KeyscanId("alice", size), 1e9, dequantise(np.full(size, 500, np.uint16)), laser=1, beams=beams)
    spread = rng.normal(size=(3, 3))
    information = spread @ spread.T + np.eye(3)
    motion = rng.uniform(-3.0, 3.0, 3)
    yield Constraint("alice", size, size + 1, ConstraintKind.ODOMETRY, motion, (information + information.T) / 2.0)
    for channel in PLACE_CHANNELS:
        shape = (size, KEYPOINT_AXES[channel])
        keypoints = rng.uniform(-12.0, 12.0, shape).astype(np.float32)
        common_bits = rng.integers(0, 256, 32, np.uint8)
        codes = common_bits ^ (rng.integers(0, 256, (size, 32), np.uint8) & rng.integers(0, 256, (size, 32), np.uint8))
        yield Place(KeyscanId("alice", size), channel, "light-1", size, size + 9, keypoints, codes)
    tag = Tag(TagFamily.APRILTAG_36H11, size % 587)
    yield TagSighting(KeyscanId("alice", size), tag, motion, (information + information.T) / 2.0)
    yield KeyscanFix(KeyscanId("alice", size), *rng.uniform(-80.0, 80.0, 3).tolist(), 1.5, (0.25, size / 4096))
    yield Correction("alice", size, 0, motion)
    yield Acknowledgement("alice", 7, size)
    yield DetectorUpdate("alice", DetectorFile(Channel.CAMERA, "light-2", 1, size, rng.bytes(32)))


def broken(rng: random.Random, corpus: list[bytes]) -> bytes:
    return mutate(rng, rng.choice(corpus), corpus)


def swap_fields(rng: random.Random, corpus: list[bytes]) -> bytes:
    """A field of a packet, at any depth, becomes another value, that of another packet, absent, or is there twice."""
    message, other = pb.Packet.FromString(rng.choice(corpus)), pb.Packet.FromString(rng.choice(corpus))
    for _ in range(rng.choice((1, 1, 2, 3))):
        part = rng.choice(list(parts(message)))
        fields = part.DESCRIPTOR.fields
        chosen = rng.choice(fields)
        donors = [each for each in parts(other) if each.DESCRIPTOR is part.DESCRIPTOR]
        if rng.random() < 0.2:
            part.ClearField(chosen.name)
        elif donors and rng.random() < 0.5:
            part.ClearField(chosen.name)
            part.MergeFrom(only(donors[0], chosen.name))
        elif not chosen.message_type:
            set_field(rng, part, chosen)
    data = message.SerializeToString()
    return data + other.SerializeToString() if rng.random() < 0.05 else data


def parts(message: Message) -> Iterator[Message]:
    """The message and every message in it."""
    yield message
    for each, value in message.ListFields():
        if each.message_type:
            for inner in value if each.is_repeated else (value,):
                yield from parts(inner)


def only(message: Message, name: str) -> Message:
    """A message with nothing but this field."""
    result = type(message)()
    for each, value in message.ListFields():
        if each.name == name:
            if each.is_repeated:
                getattr(result, name).extend(value)
            elif each.message_type:
                getattr(result, name).CopyFrom(value)
            else:
                setattr(result, name, value)
    return result


def set_field(rng: random.Random, part: Message, chosen: Any) -> None:
    kinds = type(chosen)
    value: Any
    if chosen.type in (kinds.TYPE_DOUBLE, kinds.TYPE_FLOAT):
        value = rng.choice(FLOATS)
    elif chosen.type == kinds.TYPE_STRING:
        value = rng.choice(("", "alice", "bob", "a" * 65, "../x", "\u00e9", "a\n"))
    elif chosen.type == kinds.TYPE_BYTES:
        value = rng.randbytes(rng.choice((0, 1, 2, 31, 32, 33, 300, 5000)))
    elif chosen.type == kinds.TYPE_UINT64:
        value = rng.choice(INTERESTING)
    elif chosen.type == kinds.TYPE_SINT32:
        value = rng.choice(INTERESTING) % 2**32 - 2**31
    else:
        value = rng.choice(INTERESTING) % (2**31 if chosen.type == kinds.TYPE_ENUM else 2**32)
    if chosen.is_repeated:
        getattr(part, chosen.name).extend([value] * rng.choice((1, 1, 6, 100)))
    else:
        setattr(part, chosen.name, value)


def foreign_fields(rng: random.Random, corpus: list[bytes]) -> bytes:
    """Fields that the schema does not know, groups, and messages in messages down to great depths."""
    data = rng.choice(corpus)
    added = varint(rng.getrandbits(rng.choice((4, 8, 32))) << 3 | rng.randrange(8)) + varint(rng.choice(INTERESTING))
    if rng.random() < 0.3:
        for _ in range(rng.choice((3, 99, 101, 500))):
            added = b"\x52" + varint(len(added)) + added
    at = rng.choice((0, len(data)))
    return data[:at] + added + rng.randbytes(rng.randrange(3)) + data[at:]


def varint(value: int) -> bytes:
    out = bytearray()
    while value > 127:
        out.append(value & 127 | 128)
        value >>= 7
    return bytes([*out, value])


def bomb(rng: random.Random, corpus: list[bytes]) -> bytes:
    """A stream of bytes that stands for as much as possible: constant, periodic or random, up to the limits."""
    message = pb.Packet.FromString(rng.choice(corpus))
    body = getattr(message, message.WhichOneof("body"))
    length = rng.choice((0, 1, 2, 10, 1000, 12288, 12289, 65536))
    unit = rng.randbytes(rng.choice((1, 2, 7)))
    stream = rng.choice((unit * length, rng.randbytes(length)))[:length]
    for each in body.DESCRIPTOR.fields:
        if each.type == each.TYPE_BYTES and rng.random() < 0.8:
            setattr(body, each.name, stream)
        elif "count" in each.name and rng.random() < 0.5:
            setattr(body, each.name, rng.choice(INTERESTING) % 2**32)
    return message.SerializeToString()


def noise(rng: random.Random, corpus: list[bytes]) -> bytes:
    data = rng.randbytes(rng.choice((0, 1, 5, 30, 300, 98304, 98305)) if rng.random() < 0.02 else rng.randrange(60))
    try:
        pb.Packet.FromString(data)
    except DecodeError:
        return data if rng.random() < 0.5 else rng.choice(corpus)[: rng.randrange(30)] + data
    return data


Breaker = Callable[[random.Random, list[bytes]], bytes]
BREAKERS: dict[str, Breaker] = {
    "bytes broken": broken,
    "fields swapped": swap_fields,
    "foreign fields": foreign_fields,
    "bombs": bomb,
    "noise": noise,
}
