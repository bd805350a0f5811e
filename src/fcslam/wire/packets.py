"""Encoding and decoding of packets (format: docs/reference/wire.md)."""

from dataclasses import replace
from typing import Any, NamedTuple

from google.protobuf.message import DecodeError

from fcslam.errors import PacketError
from fcslam.geometry.voxels import MOST_POINTS
from fcslam.records import CODE_BYTES, Channel, Place, VoxelMap
from fcslam.wire import fcslam_pb2 as pb
from fcslam.wire import limits
from fcslam.wire.bodies import CODECS, KIND_OF_TYPE, read_channel, received
from fcslam.wire.checks import check, check_name
from fcslam.wire.messages import Body, Packet, PacketKind

_VERSIONS = limits.VERSION, limits.SPACE_VERSION


class Label(NamedTuple):
    """Attributes by which the traffic of a packet is counted."""

    robot: str
    kind: PacketKind
    channel: Channel | None = None
    """Channel of a place; None for other kinds."""


def encode(packet: Packet) -> bytes:
    """Encode a packet. Keypoints are rounded to 1 cm and information matrices to float32; the rest is exact."""
    check(packet)
    kind = KIND_OF_TYPE[type(packet.body)]
    _, write, _ = CODECS[kind]
    body: dict[str, Any] = {kind: write(packet.body)}
    message = pb.Packet(
        version=_version_of(packet.body),
        robot=packet.robot,
        epoch=packet.epoch,
        sequence=packet.sequence,
        time=packet.time,
        **body,
    )
    return message.SerializeToString(deterministic=True)


class SizedPacket(NamedTuple):
    """A packet as its receiver reads it, and as it is sent."""

    packet: Packet
    data: bytes

    @property
    def label(self) -> Label:
        """By which its traffic is counted."""
        body = self.packet.body
        return Label(self.packet.robot, KIND_OF_TYPE[type(body)], body.channel if isinstance(body, Place) else None)


def measure(packet: Packet) -> SizedPacket:
    """Return the packet as a receiver reads it, and its bytes."""
    return SizedPacket(replace(packet, body=received(packet.body)), encode(packet))


def decode(data: bytes) -> Packet:
    """Decode a packet and check what does not depend on other packets; a ``PacketError`` says why it is not valid."""
    message, kind = _parse(data)
    _, _, read = CODECS[kind]
    body = read(getattr(message, kind), message)
    packet = Packet(message.robot, message.epoch, message.sequence, message.time, body)
    if message.version != _version_of(body):
        raise PacketError(f"a packet of version {_version_of(body)} says that it is of version {message.version}")
    check(packet)
    return packet


def _version_of(body: Body) -> int:
    """The lowest version that has what the record needs."""
    return limits.SPACE_VERSION if is_in_space(body) else limits.VERSION


def is_in_space(body: Body) -> bool:
    """Whether a record has poses in space."""
    pose = getattr(body, "T_i_j", getattr(body, "T_map_odom", None))
    return isinstance(body, VoxelMap) or (pose is not None and pose.shape == (7,))


def readdress(data: bytes, epoch: int, sequence: int) -> bytes:
    """The same packet with another epoch and sequence number."""
    message, _ = _parse(data)
    message.epoch, message.sequence = epoch, sequence
    return message.SerializeToString(deterministic=True)


def read_label(data: bytes) -> Label:
    """Robot, kind and channel of a packet; its body is not decoded or checked."""
    message, kind = _parse(data)
    check_name(message.robot, "robot")
    return Label(message.robot, kind, read_channel(message.place.channel) if kind is PacketKind.PLACE else None)


def unpacked_size(data: bytes) -> int:
    """Bytes of a packet with its streams unpacked, by its counts: a short stream may take as long to decode.

    For bytes that are not a packet it is their length; ``decode`` refuses them before it unpacks anything.
    """
    try:
        message, kind = _parse(data)
    except PacketError:
        return len(data)
    if kind is PacketKind.KEYSCAN:
        return len(data) + limits.BYTES_PER_RANGE * min(message.keyscan.count, limits.MAXIMUM_BEAMS)
    if kind is PacketKind.PLACE:
        each = limits.BYTES_PER_AXIS * max(limits.KEYPOINT_AXES.values()) + CODE_BYTES
        return len(data) + each * min(message.place.count, limits.MAXIMUM_KEYPOINTS)
    if kind is PacketKind.VOXEL_MAP:
        return len(data) + limits.BYTES_PER_POINT * min(message.voxel_map.count, MOST_POINTS)
    return len(data)


def read_number(data: bytes) -> tuple[str, int, int] | None:
    """Robot, epoch and sequence of a packet that ``decode`` refuses, which keeps its number; None if unreadable."""
    message = pb.Packet()
    try:
        message.ParseFromString(data)
        check_name(message.robot, "robot")
    except (DecodeError, PacketError):
        return None
    numbered = message.epoch <= limits.MAXIMUM_EPOCH and message.sequence <= limits.MAXIMUM_SEQUENCE
    known = message.version in _VERSIONS and numbered
    return (message.robot, message.epoch, message.sequence) if known else None


def _parse(data: bytes) -> tuple[pb.Packet, PacketKind]:
    if len(data) > limits.MAXIMUM_PACKET_BYTES:
        raise PacketError(f"{len(data)} bytes, at most {limits.MAXIMUM_PACKET_BYTES}")
    message = pb.Packet()
    try:
        message.ParseFromString(data)
    except DecodeError as error:
        raise PacketError("not a protobuf message of a packet") from error
    if message.version not in _VERSIONS:
        known = " and ".join(map(str, _VERSIONS))
        raise PacketError(f"version {message.version} is unknown, this side speaks versions {known}")
    message.DiscardUnknownFields()
    if message.ByteSize() != len(data):
        raise PacketError("unknown, repeated or overlong fields")
    kind = message.WhichOneof("body")
    if kind is None:
        raise PacketError("the packet is empty")
    return message, PacketKind(kind)
