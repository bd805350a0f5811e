"""Conversion between records and protobuf messages, with writing and reading side by side."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from google.protobuf.message import Message

from fcslam.errors import PacketError
from fcslam.records import (
    CODE_BYTES,
    Beams,
    Channel,
    Constraint,
    ConstraintKind,
    Correction,
    DetectorFile,
    FloatArray,
    Keyscan,
    KeyscanFix,
    KeyscanId,
    LaserModel,
    Place,
    Sweep,
    Tag,
    TagFamily,
    TagSighting,
    frozen,
)
from fcslam.wire import fcslam_pb2 as pb
from fcslam.wire import limits
from fcslam.wire.messages import Acknowledgement, DetectorUpdate, Hello, PacketKind
from fcslam.wire.quantisation import (
    dequantise,
    dequantise_keypoints,
    pack_information,
    quantise,
    quantise_keypoints,
    unpack_information,
)
from fcslam.wire.streams import (
    ascending,
    pack_descriptors,
    pack_keypoints,
    pack_ranges,
    unpack_descriptors,
    unpack_keypoints,
    unpack_ranges,
)

_CHANNELS = {Channel.LIDAR: pb.CHANNEL_LIDAR, Channel.CAMERA: pb.CHANNEL_CAMERA}
_CONSTRAINT_KINDS = {
    ConstraintKind.ODOMETRY: pb.CONSTRAINT_KIND_ODOMETRY,
    ConstraintKind.CLOSURE: pb.CONSTRAINT_KIND_CLOSURE,
}
_CHANNEL_OF_CODE = {int(code): channel for channel, code in _CHANNELS.items()}
_CONSTRAINT_KIND_OF_CODE = {int(code): kind for kind, code in _CONSTRAINT_KINDS.items()}


def _write_hello(hello: Hello) -> pb.Hello:
    return pb.Hello(
        lasers=map(_write_laser, hello.lasers),
        detectors=[
            pb.Detector(channel=code, version=hello.detector_versions[channel])
            for channel, code in _CHANNELS.items()
            if channel in hello.detector_versions
        ],
        floor=hello.floor,
    )


def _read_hello(message: pb.Hello, envelope: pb.Packet) -> Hello:
    _check_at_most(len(message.lasers), limits.MAXIMUM_LASERS, "hello: lasers")
    lasers = tuple(map(_read_laser, message.lasers))
    codes = [detector.channel for detector in message.detectors]
    if codes != sorted(set(codes)):
        raise PacketError("hello: detectors are not in ascending order of their channels")
    channels = [read_channel(code) for code in codes]
    versions = {channel: each.version for channel, each in zip(channels, message.detectors, strict=True)}
    return Hello(envelope.robot, envelope.epoch, lasers, versions, message.floor)


def _write_laser(laser: LaserModel) -> pb.Laser:
    return pb.Laser(
        beam_count=laser.beam_count,
        angle_min_rad=laser.angle_min_rad,
        angle_increment_rad=laser.angle_increment_rad,
        max_range_m=laser.max_range_m,
        t_base_laser=_write_pose(frozen(laser.T_base_laser)),
    )


def _read_laser(message: pb.Laser) -> LaserModel:
    x, y, theta = _read_pose(message, "t_base_laser").tolist()
    return LaserModel(
        message.beam_count, message.angle_min_rad, message.angle_increment_rad, message.max_range_m, (x, y, theta)
    )


def _write_keyscan(keyscan: Keyscan) -> pb.Keyscan:
    codes, beams = quantise(keyscan.ranges_m), keyscan.beams
    return pb.Keyscan(
        number=keyscan.id.number,
        stamp=keyscan.stamp,
        count=len(codes),
        ranges=pack_ranges(codes),
        laser=keyscan.laser,
        beams=beams and pb.Beams(angle_min_rad=beams.angle_min_rad, angle_increment_rad=beams.angle_increment_rad),
        sweep=None if keyscan.sweep is None else keyscan.sweep.steps(),
    )


def _read_keyscan(message: pb.Keyscan, envelope: pb.Packet) -> Keyscan:
    _check_at_most(message.count, limits.MAXIMUM_BEAMS, "keyscan: ranges")
    ranges = dequantise(unpack_ranges(message.ranges, message.count))
    beams = None
    if message.HasField("beams"):
        beams = Beams(message.count, message.beams.angle_min_rad, message.beams.angle_increment_rad)
    if len(message.sweep) not in (0, limits.SWEEP_NUMBERS):
        raise PacketError(f"keyscan: sweep has {len(message.sweep)} numbers, not {limits.SWEEP_NUMBERS}")
    sweep = Sweep.of_steps(message.sweep) if message.sweep else None
    return Keyscan(KeyscanId(envelope.robot, message.number), message.stamp, ranges, message.laser, beams, sweep)


def _write_constraint(constraint: Constraint) -> pb.Constraint:
    return pb.Constraint(
        i=constraint.i,
        j=constraint.j,
        kind=_CONSTRAINT_KINDS[constraint.kind],
        t_i_j=_write_pose(constraint.T_i_j),
        information=pack_information(constraint.information),
    )


def _read_constraint(message: pb.Constraint, envelope: pb.Packet) -> Constraint:
    kind = _CONSTRAINT_KIND_OF_CODE.get(message.kind)
    if kind is None:
        raise PacketError(f"constraint: kind {message.kind} is unknown")
    information = _read_information(message.information, "constraint")
    return Constraint(envelope.robot, message.i, message.j, kind, _read_pose(message, "t_i_j"), information)


def _read_information(numbers: Sequence[float], what: str) -> FloatArray:
    if len(numbers) != 6:
        raise PacketError(f"{what}: information has {len(numbers)} numbers, not 6")
    return unpack_information(numbers)


def _write_place(place: Place) -> pb.Place:
    """The keypoints in ascending order, with their descriptors."""
    codes = quantise_keypoints(place.keypoints)
    order = ascending(codes)
    return pb.Place(
        number=place.id.number,
        channel=_CHANNELS[place.channel],
        detector_version=place.detector_version,
        first=place.first,
        last=place.last,
        count=len(codes),
        keypoints=pack_keypoints(codes[order]),
        descriptors=pack_descriptors(place.descriptors[order]),
    )


def _read_place(message: pb.Place, envelope: pb.Packet) -> Place:
    _check_at_most(message.count, limits.MAXIMUM_KEYPOINTS, "place: keypoints")
    channel = read_channel(message.channel)
    codes = unpack_keypoints(message.keypoints, message.count, limits.KEYPOINT_AXES[channel])
    return Place(
        KeyscanId(envelope.robot, message.number),
        channel,
        message.detector_version,
        message.first,
        message.last,
        dequantise_keypoints(codes),
        frozen(unpack_descriptors(message.descriptors, message.count), np.uint8),
    )


def _write_tag_sighting(sighting: TagSighting) -> pb.TagSighting:
    return pb.TagSighting(
        number=sighting.id.number,
        family=sighting.tag.family,
        tag=sighting.tag.number,
        t_base_tag=_write_pose(sighting.T_base_tag),
        information=pack_information(sighting.information),
    )


def _read_tag_sighting(message: pb.TagSighting, envelope: pb.Packet) -> TagSighting:
    if message.family not in tuple(TagFamily):
        raise PacketError(f"tag sighting: the family {message.family[:32]!r} is unknown")
    return TagSighting(
        KeyscanId(envelope.robot, message.number),
        Tag(TagFamily(message.family), message.tag),
        _read_pose(message, "t_base_tag"),
        _read_information(message.information, "tag sighting"),
    )


def _write_fix(fix: KeyscanFix) -> pb.KeyscanFix:
    x, y = fix.antenna_xy
    return pb.KeyscanFix(
        number=fix.id.number,
        latitude_deg=fix.latitude_deg,
        longitude_deg=fix.longitude_deg,
        altitude_m=fix.altitude_m,
        sigma_m=fix.sigma_m,
        antenna_x_m=x,
        antenna_y_m=y,
    )


def _read_fix(message: pb.KeyscanFix, envelope: pb.Packet) -> KeyscanFix:
    return KeyscanFix(
        KeyscanId(envelope.robot, message.number),
        message.latitude_deg,
        message.longitude_deg,
        message.altitude_m,
        message.sigma_m,
        (message.antenna_x_m, message.antenna_y_m),
    )


def _check_at_most(count: int, most: int, what: str) -> None:
    """Refuse a count before memory is allocated for it."""
    if count > most:
        raise PacketError(f"{what}: {count}, at most {most}")


def _write_correction(correction: Correction) -> pb.Correction:
    return pb.Correction(
        version=correction.version,
        map_index=correction.map_index,
        t_map_odom=_write_pose(correction.T_map_odom),
        quality=correction.quality,
    )


def _read_correction(message: pb.Correction, envelope: pb.Packet) -> Correction:
    pose = _read_pose(message, "t_map_odom")
    return Correction(envelope.robot, message.version, message.map_index, pose, message.quality)


def _write_acknowledgement(acknowledgement: Acknowledgement) -> pb.Acknowledgement:
    return pb.Acknowledgement(epoch=acknowledgement.epoch, sequence=acknowledgement.sequence)


def _read_acknowledgement(message: pb.Acknowledgement, envelope: pb.Packet) -> Acknowledgement:
    return Acknowledgement(envelope.robot, message.epoch, message.sequence)


def _write_detector_update(update: DetectorUpdate) -> pb.DetectorUpdate:
    file = update.file
    return pb.DetectorUpdate(
        channel=_CHANNELS[file.channel], version=file.version, format=file.format, size=file.size, sha256=file.sha256
    )


def _read_detector_update(message: pb.DetectorUpdate, envelope: pb.Packet) -> DetectorUpdate:
    channel = read_channel(message.channel)
    file = DetectorFile(channel, message.version, message.format, message.size, message.sha256)
    return DetectorUpdate(envelope.robot, file)


def _write_pose(pose: FloatArray) -> pb.Pose:
    x, y, theta = pose.tolist()
    return pb.Pose(x_m=x, y_m=y, theta_rad=theta)


def _read_pose(message: Message, field: str) -> FloatArray:
    """Refuse an absent pose; it would read as the identity."""
    if not message.HasField(field):
        raise PacketError(f"{message.DESCRIPTOR.name.lower()}: {field} is missing")
    pose: pb.Pose = getattr(message, field)
    return frozen((pose.x_m, pose.y_m, pose.theta_rad))


def read_channel(code: int) -> Channel:
    """The channel of a code in a packet."""
    channel = _CHANNEL_OF_CODE.get(code)
    if channel is None:
        raise PacketError(f"channel {code} is unknown")
    return channel


def _always(number: int) -> Callable[[Any], int]:
    return lambda _: number


def _for_each(size: int, most: int) -> Callable[[Any], int]:
    """Bytes of a message's streams with ``size`` for each item; more than ``most`` are refused before."""
    return lambda message: size * min(message.count, most)


_KEYPOINT_BYTES = limits.BYTES_PER_AXIS * max(limits.KEYPOINT_AXES.values())
_RANGES = _for_each(limits.BYTES_PER_RANGE, limits.MAXIMUM_BEAMS)
_DESCRIBED = _for_each(_KEYPOINT_BYTES + CODE_BYTES, limits.MAXIMUM_KEYPOINTS)


class Codec(NamedTuple):
    """One kind of record. Its reader takes robot and epoch from the envelope."""

    type: type
    write: Callable[[Any], Message]
    read: Callable[[Any, pb.Packet], Any]
    unpacked_bytes: Callable[[Any], int] = _always(0)
    """Bytes of the streams of a message, unpacked, by its counts."""


CODECS = {
    PacketKind.HELLO: Codec(Hello, _write_hello, _read_hello),
    PacketKind.KEYSCAN: Codec(Keyscan, _write_keyscan, _read_keyscan, _RANGES),
    PacketKind.CONSTRAINT: Codec(Constraint, _write_constraint, _read_constraint),
    PacketKind.PLACE: Codec(Place, _write_place, _read_place, _DESCRIBED),
    PacketKind.TAG_SIGHTING: Codec(TagSighting, _write_tag_sighting, _read_tag_sighting),
    PacketKind.KEYSCAN_FIX: Codec(KeyscanFix, _write_fix, _read_fix),
    PacketKind.CORRECTION: Codec(Correction, _write_correction, _read_correction),
    PacketKind.ACKNOWLEDGEMENT: Codec(Acknowledgement, _write_acknowledgement, _read_acknowledgement),
    PacketKind.DETECTOR_UPDATE: Codec(DetectorUpdate, _write_detector_update, _read_detector_update),
}
"""All that depends on the kind of a packet, but for its checks (``fcslam.wire.checks``)."""
CODEC_OF_TYPE = {codec.type: (kind, codec) for kind, codec in CODECS.items()}
