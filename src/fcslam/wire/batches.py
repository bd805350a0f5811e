"""Batches: several packets in one request or reply, each preceded by its length (docs/reference/wire.md)."""

import struct
from collections.abc import Iterable

from fcslam.errors import PacketError
from fcslam.wire.limits import MAXIMUM_BATCH_BYTES, MAXIMUM_BATCH_PACKETS, MAXIMUM_PACKET_BYTES

MEDIA_TYPE = "application/vnd.fcslam.packets"
"""Content type of requests and replies."""
CORRECTION_HEADER = "Fcslam-Correction"
"""Version of the newest correction that the robot has; absent: none."""
AGENT_HEADER = "Fcslam-Agent"
"""128 random bits in hexadecimal that distinguish two agents of the same name."""
ENDED_HEADER = "Fcslam-Ended"
"""1: the robot ends, and has sent everything."""

REMOVED_HEADER = "Fcslam-Removed"
"""Header of a response: 1 if an administrator removed the robot's session, and its packets have no effect; else 0."""
REFUSED_HEADER = "Fcslam-Refused"
"""In a reply: number of the robot's packets that were refused."""

LENGTH = struct.Struct(">I")
"""Length of the packet that follows: 4 bytes, big endian."""


def write_batch(packets: Iterable[bytes]) -> bytes:
    """Join encoded packets to one batch; no packets give no bytes."""
    chosen = tuple(packets)
    _check_count(len(chosen))
    for index, packet in enumerate(chosen):
        _check_length(len(packet), index)
    data = b"".join(part for packet in chosen for part in (LENGTH.pack(len(packet)), packet))
    _check_size(len(data))
    return data


def read_batch(data: bytes) -> list[bytes]:
    """Split a batch into encoded packets, without decoding them.

    A ``PacketError`` says why ``data`` is not a batch. No packet is returned then, as any byte may be corrupt.
    """
    _check_size(len(data))
    packets: list[bytes] = []
    at = 0
    while at < len(data):
        _check_count(len(packets) + 1)
        start = at + LENGTH.size
        if start > len(data):
            raise PacketError(f"batch: it ends within the length of packet {len(packets)}")
        (length,) = LENGTH.unpack_from(data, at)
        _check_length(length, len(packets))
        at = start + length
        if at > len(data):
            raise PacketError(f"batch: it ends within packet {len(packets)}, {at - len(data)} bytes early")
        packets.append(data[start:at])
    return packets


def _check_count(count: int) -> None:
    if count > MAXIMUM_BATCH_PACKETS:
        raise PacketError(f"batch: over {MAXIMUM_BATCH_PACKETS} packets")


def _check_length(length: int, index: int) -> None:
    if not 0 < length <= MAXIMUM_PACKET_BYTES:
        raise PacketError(f"batch: packet {index} has {length} bytes, not 1 to {MAXIMUM_PACKET_BYTES}")


def _check_size(size: int) -> None:
    if size > MAXIMUM_BATCH_BYTES:
        raise PacketError(f"batch: {size} bytes, at most {MAXIMUM_BATCH_BYTES}")
