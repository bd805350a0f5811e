"""Conversion between records and protobuf messages, with writing and reading side by side."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from operator import attrgetter
from typing import Any

import numpy as np
from google.protobuf.message import Message

from fcslam.errors import PacketError
from fcslam.geometry.voxels import MOST_POINTS, are_inside
from fcslam.records import (
    SWEEP_STEPS,
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
    VoxelMap,
    frozen,
)
from fcslam.wire import fcslam_pb2 as pb
from fcslam.wire import limits
from fcslam.wire.messages import Acknowledgement, Body, DetectorUpdate, Hello, PacketKind
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
    pack_points,
    pack_ranges,
    unpack_descriptors,
    unpack_keypoints,
    unpack_points,
    unpack_ranges,
)

_CHANNELS = {Channel.LIDAR: pb.CHANNEL_LIDAR, Channel.CAMERA: pb.CHANNEL_CAMERA}
_CONSTRAINT_KINDS = {
    ConstraintKind.ODOMETRY: pb.CONSTRAINT_KIND_ODOMETRY,
    ConstraintKind.CLOSURE: pb.CONSTRAINT_KIND_CLOSURE,
}
_OF_POSE = "x_m", "y_m", "theta_rad"
_OF_SPACE_POSE = "x_m", "y_m", "z_m", "qx", "qy", "qz", "qw"
_OF_LASER = "beam_count", "angle_min_rad", "angle_increment_rad", "max_range_m"
_OF_PLACE = "detector_version", "first", "last"
_OF_FIX = "latitude_deg", "longitude_deg", "altitude_m", "sigma_m"
_OF_CORRECTION = "version", "map_index", "quality"
_OF_FILE = "version", "format", "size", "sha256"
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
    return pb.Laser(**_values(laser, _OF_LASER), t_base_laser=_write_pose(frozen(laser.T_base_laser)))


def _read_laser(message: pb.Laser) -> LaserModel:
    x, y, theta = _read_pose(message, "t_base_laser").tolist()
    return LaserModel(**_values(message, _OF_LASER), T_base_laser=(x, y, theta))


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
    if len(message.sweep) not in (0, len(SWEEP_STEPS)):
        raise PacketError(f"keyscan: sweep has {len(message.sweep)} numbers, not {len(SWEEP_STEPS)}")
    sweep = Sweep.of_steps(message.sweep) if message.sweep else None
    return Keyscan(KeyscanId(envelope.robot, message.number), message.stamp, ranges, message.laser, beams, sweep)


def _write_constraint(constraint: Constraint) -> pb.Constraint:
    return pb.Constraint(
        i=constraint.i,
        j=constraint.j,
        kind=_CONSTRAINT_KINDS[constraint.kind],
        **_pose_field("t_i_j", constraint.T_i_j),
        information=pack_information(constraint.information),
    )


def _read_constraint(message: pb.Constraint, envelope: pb.Packet) -> Constraint:
    kind = _CONSTRAINT_KIND_OF_CODE.get(message.kind)
    if kind is None:
        raise PacketError(f"constraint: kind {message.kind} is unknown")
    T_i_j = _read_pose_field(message, "t_i_j")
    information = _read_information(message.information, "constraint", 6 if len(T_i_j) == 3 else 21)
    return Constraint(envelope.robot, message.i, message.j, kind, T_i_j, information)


def _read_information(numbers: Sequence[float], what: str, count: int = 6) -> FloatArray:
    if len(numbers) != count:
        raise PacketError(f"{what}: information has {len(numbers)} numbers, not {count}")
    return unpack_information(numbers)


def _write_place(place: Place) -> pb.Place:
    """The keypoints in ascending order, with their descriptors."""
    codes = quantise_keypoints(place.keypoints)
    order = ascending(codes)
    return pb.Place(
        number=place.id.number,
        channel=_CHANNELS[place.channel],
        count=len(codes),
        keypoints=pack_keypoints(codes[order]),
        descriptors=pack_descriptors(place.descriptors[order]),
        **_values(place, _OF_PLACE),
    )


def _read_place(message: pb.Place, envelope: pb.Packet) -> Place:
    _check_at_most(message.count, limits.MAXIMUM_KEYPOINTS, "place: keypoints")
    channel = read_channel(message.channel)
    codes = unpack_keypoints(message.keypoints, message.count, limits.KEYPOINT_AXES[channel])
    return Place(
        id=KeyscanId(envelope.robot, message.number),
        channel=channel,
        keypoints=dequantise_keypoints(codes),
        descriptors=frozen(unpack_descriptors(message.descriptors, message.count), np.uint8),
        **_values(message, _OF_PLACE),
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
    return pb.KeyscanFix(number=fix.id.number, antenna_x_m=x, antenna_y_m=y, **_values(fix, _OF_FIX))


def _read_fix(message: pb.KeyscanFix, envelope: pb.Packet) -> KeyscanFix:
    antenna_xy = message.antenna_x_m, message.antenna_y_m
    return KeyscanFix(KeyscanId(envelope.robot, message.number), antenna_xy=antenna_xy, **_values(message, _OF_FIX))


def _write_voxel_map(local: VoxelMap) -> pb.VoxelMap:
    return pb.VoxelMap(
        number=local.id.number,
        first=local.first,
        last=local.last,
        t_base_ground=_write_space_pose(local.T_base_ground),
        count=len(local.points),
        points=pack_points(local.points, local.seen_from),
        origins=local.origins.ravel().tolist(),
    )


def _read_voxel_map(message: pb.VoxelMap, envelope: pb.Packet) -> VoxelMap:
    _check_at_most(message.count, MOST_POINTS, "voxel map: points")
    _check_at_most(len(message.origins), 3 * limits.MAXIMUM_ORIGINS, "voxel map: coordinates of origins")
    points, seen_from = unpack_points(message.points, message.count)
    origins = np.array(message.origins, np.int64)
    if len(origins) % 3 or not are_inside(origins.reshape(-1, 3)):
        raise PacketError("voxel map: an origin is incomplete or outside the bounds")
    return VoxelMap(
        KeyscanId(envelope.robot, message.number),
        message.first,
        message.last,
        _read_pose(message, "t_base_ground", _OF_SPACE_POSE),
        frozen(points, np.int16),
        frozen(origins.reshape(-1, 3), np.int16),
        frozen(seen_from, np.uint8),
    )


def _check_at_most(count: int, most: int, what: str) -> None:
    """Refuse a count before memory is allocated for it."""
    if count > most:
        raise PacketError(f"{what}: {count}, at most {most}")


def _write_correction(correction: Correction) -> pb.Correction:
    return pb.Correction(**_pose_field("t_map_odom", correction.T_map_odom), **_values(correction, _OF_CORRECTION))


def _read_correction(message: pb.Correction, envelope: pb.Packet) -> Correction:
    pose = _read_pose_field(message, "t_map_odom")
    return Correction(envelope.robot, T_map_odom=pose, **_values(message, _OF_CORRECTION))


def _write_acknowledgement(acknowledgement: Acknowledgement) -> pb.Acknowledgement:
    return pb.Acknowledgement(epoch=acknowledgement.epoch, sequence=acknowledgement.sequence)


def _read_acknowledgement(message: pb.Acknowledgement, envelope: pb.Packet) -> Acknowledgement:
    return Acknowledgement(envelope.robot, message.epoch, message.sequence)


def _write_detector_update(update: DetectorUpdate) -> pb.DetectorUpdate:
    return pb.DetectorUpdate(channel=_CHANNELS[update.file.channel], **_values(update.file, _OF_FILE))


def _read_detector_update(message: pb.DetectorUpdate, envelope: pb.Packet) -> DetectorUpdate:
    return DetectorUpdate(envelope.robot, DetectorFile(read_channel(message.channel), **_values(message, _OF_FILE)))


def received(body: Body) -> Body:
    """A record as its receiver reads it."""
    match body:
        case Constraint() | TagSighting():
            return replace(body, information=unpack_information(pack_information(body.information)))
        case Place():
            codes = quantise_keypoints(body.keypoints)
            order = ascending(codes)
            descriptors = frozen(body.descriptors[order], np.uint8)
            return replace(body, keypoints=dequantise_keypoints(codes[order]), descriptors=descriptors)
    return body


def _values(source: object, names: tuple[str, ...]) -> dict[str, Any]:
    """The fields that a record and its message have in common."""
    return {name: getattr(source, name) for name in names}


def _write_pose(pose: FloatArray) -> pb.Pose:
    return pb.Pose(**dict(zip(_OF_POSE, pose.tolist(), strict=True)))


def _write_space_pose(pose: FloatArray) -> pb.SpacePose:
    return pb.SpacePose(**dict(zip(_OF_SPACE_POSE, pose.tolist(), strict=True)))


def _read_pose(message: Message, field: str, of_pose: tuple[str, ...] = _OF_POSE) -> FloatArray:
    """Refuse an absent pose; it would read as the identity."""
    if not message.HasField(field):
        raise PacketError(f"{message.DESCRIPTOR.name.lower()}: {field} is missing")
    return frozen(attrgetter(*of_pose)(getattr(message, field)))


def _pose_field(name: str, pose: FloatArray) -> dict[str, Any]:
    """A pose in the field of its group."""
    return {name: _write_pose(pose)} if pose.shape == (3,) else {f"{name}_space": _write_space_pose(pose)}


def _read_pose_field(message: Message, name: str) -> FloatArray:
    if not message.HasField(f"{name}_space"):
        return _read_pose(message, name)
    if message.HasField(name):
        raise PacketError(f"{message.DESCRIPTOR.name.lower()}: {name} is there twice")
    return _read_pose(message, f"{name}_space", _OF_SPACE_POSE)


def read_channel(code: int) -> Channel:
    """The channel of a code in a packet."""
    channel = _CHANNEL_OF_CODE.get(code)
    if channel is None:
        raise PacketError(f"channel {code} is unknown")
    return channel


CODECS: dict[PacketKind, tuple[type, Callable[[Any], Message], Callable[[Any, pb.Packet], Any]]] = {
    PacketKind.HELLO: (Hello, _write_hello, _read_hello),
    PacketKind.KEYSCAN: (Keyscan, _write_keyscan, _read_keyscan),
    PacketKind.CONSTRAINT: (Constraint, _write_constraint, _read_constraint),
    PacketKind.PLACE: (Place, _write_place, _read_place),
    PacketKind.TAG_SIGHTING: (TagSighting, _write_tag_sighting, _read_tag_sighting),
    PacketKind.KEYSCAN_FIX: (KeyscanFix, _write_fix, _read_fix),
    PacketKind.VOXEL_MAP: (VoxelMap, _write_voxel_map, _read_voxel_map),
    PacketKind.CORRECTION: (Correction, _write_correction, _read_correction),
    PacketKind.ACKNOWLEDGEMENT: (Acknowledgement, _write_acknowledgement, _read_acknowledgement),
    PacketKind.DETECTOR_UPDATE: (DetectorUpdate, _write_detector_update, _read_detector_update),
}
"""The record of each kind, what writes it, and what reads it with the robot and epoch of its envelope."""
KIND_OF_TYPE = {record: kind for kind, (record, _, _) in CODECS.items()}
