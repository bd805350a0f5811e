"""Packets to bytes and back; docs/wire.md says what the bytes mean."""

from typing import Any, NamedTuple

from google.protobuf.message import DecodeError

from fcslam.errors import PacketError
from fcslam.records import CODE_BYTES, Channel
from fcslam.wire import fcslam_pb2 as pb
from fcslam.wire.bodies import CODEC_OF_TYPE, CODECS, read_channel
from fcslam.wire.checks import check, check_name
from fcslam.wire.limits import (
    BYTES_PER_AXIS,
    BYTES_PER_RANGE,
    KEYPOINT_AXES,
    MAXIMUM_BEAMS,
    MAXIMUM_KEYPOINTS,
    MAXIMUM_PACKET_BYTES,
    MAXIMUM_SEQUENCE,
    PROTOCOL_VERSION,
)
from fcslam.wire.messages import Packet, PacketKind


class Label(NamedTuple):
    """What a packet's traffic is counted by."""

    robot: str
    kind: PacketKind
    channel: Channel | None = None
    """Of a place; None for every other kind."""


def encode(packet: Packet) -> bytes:
    """The bytes of a packet; keypoints are rounded to 1 cm, information matrices to float32, nothing else changes.

    Raises:
        PacketError: the packet breaks a limit of the format, with the reason.
    """
    check(packet)
    kind, codec = CODEC_OF_TYPE[type(packet.body)]
    body: dict[str, Any] = {kind: codec.write(packet.body)}
    message = pb.Packet(
        version=PROTOCOL_VERSION,
        robot=packet.robot,
        epoch=packet.epoch,
        sequence=packet.sequence,
        time=packet.time,
        **body,
    )
    return message.SerializeToString(deterministic=True)


def decode(data: bytes) -> Packet:
    """The packet that ``encode`` made ``data`` of, checked in everything that one packet alone can tell.

    Raises:
        PacketError: ``data`` is not a valid packet of a known version, with the reason.
    """
    message, kind = _parse(data)
    body = CODECS[kind].read(getattr(message, kind), message)
    packet = Packet(message.robot, message.epoch, message.sequence, message.time, body)
    check(packet)
    return packet


def readdress(data: bytes, epoch: int, sequence: int) -> bytes:
    """The same packet with another epoch and number on its envelope.

    Raises:
        PacketError: ``data`` is not a packet of a known version, with the reason.
    """
    message, _ = _parse(data)
    message.epoch, message.sequence = epoch, sequence
    return message.SerializeToString(deterministic=True)


def read_label(data: bytes) -> Label:
    """Robot, kind and channel of a packet without the cost, and without the checks, of reading its body.

    Raises:
        PacketError: ``data`` is not a packet of a known version, or a place of an unknown channel, with the reason.
    """
    message, kind = _parse(data)
    check_name(message.robot, "robot")
    return Label(message.robot, kind, read_channel(message.place.channel) if kind is PacketKind.PLACE else None)


def unpacked_size(data: bytes) -> int:
    """Bytes of a packet with its streams unpacked, as its counts tell them without the cost of reading its body.

    What a robot may ask for is measured by it: a stream of few bytes may take as long to read as a long one. What is
    no packet has the size that it has; its reader refuses it before it unpacks anything.
    """
    try:
        message, kind = _parse(data)
    except PacketError:
        return len(data)
    if kind is PacketKind.KEYSCAN:
        return len(data) + BYTES_PER_RANGE * min(message.keyscan.count, MAXIMUM_BEAMS)
    if kind is PacketKind.PLACE:
        axes = max(KEYPOINT_AXES.values())
        return len(data) + (BYTES_PER_AXIS * axes + CODE_BYTES) * min(message.place.count, MAXIMUM_KEYPOINTS)
    return len(data)


def read_number(data: bytes) -> tuple[str, int, int] | None:
    """Robot, epoch and sequence of what ``decode`` refuses: whose number is used up by it; None if nobody can tell."""
    message = pb.Packet()
    try:
        message.ParseFromString(data)
        check_name(message.robot, "robot")
    except (DecodeError, PacketError):
        return None
    known = message.version == PROTOCOL_VERSION and max(message.epoch, message.sequence) <= MAXIMUM_SEQUENCE
    return (message.robot, message.epoch, message.sequence) if known else None


def _parse(data: bytes) -> tuple[pb.Packet, PacketKind]:
    if len(data) > MAXIMUM_PACKET_BYTES:
        raise PacketError(f"{len(data)} bytes, at most {MAXIMUM_PACKET_BYTES}")
    message = pb.Packet()
    try:
        message.ParseFromString(data)
    except DecodeError as error:
        raise PacketError("not a protobuf message of a packet") from error
    if message.version != PROTOCOL_VERSION:
        raise PacketError(f"version {message.version} is unknown, this side speaks version {PROTOCOL_VERSION}")
    message.DiscardUnknownFields()
    if message.ByteSize() != len(data):
        raise PacketError("unknown, repeated or overlong fields")
    kind = message.WhichOneof("body")
    if kind is None:
        raise PacketError("the packet is empty")
    return message, PacketKind(kind)
