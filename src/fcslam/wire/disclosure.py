"""Fields of the schema that leave a robot or come back, with the information that each field reveals."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

from google.protobuf.descriptor import FieldDescriptor

from fcslam.wire import fcslam_pb2 as pb
from fcslam.wire.messages import UPLINK, PacketKind

REVEALS: Mapping[str, str] = MappingProxyType(
    {
        "Packet.version": "nothing of the robot",
        "Packet.robot": "which robot it is",
        "Packet.epoch": "how often it was started",
        "Packet.sequence": "how many packets it has sent",
        "Packet.time": "when it drove, by its own clock",
        "Hello.lasers": "how many LiDARs it has",
        "Hello.detectors": "whether it has a camera, and which software describes what it sees",
        "Hello.floor": "which floor it drives on",
        "Laser.beam_count": "which LiDAR it has",
        "Laser.angle_min_rad": "which LiDAR it has, and how it is mounted",
        "Laser.angle_increment_rad": "which LiDAR it has",
        "Laser.max_range_m": "which LiDAR it has",
        "Laser.t_base_laser": "where its LiDAR is mounted",
        "Detector.channel": "whether it has a camera",
        "Detector.version": "which network it uses, and so which training it took part in",
        "Detector.vocabulary": "which vocabulary it shares with the fleet, and that it sends words only",
        "Keyscan.number": "how far it has driven",
        "Keyscan.stamp": "when it was there, by its own clock",
        "Keyscan.count": "which LiDAR it has",
        "Keyscan.ranges": "the floor plan at the height of the LiDAR: walls, doors, furniture, legs of people",
        "Keyscan.laser": "which of its LiDARs measured this",
        "Keyscan.beams": "whether the beams of its LiDAR vary",
        "Keyscan.sweep": "how fast its LiDAR turns, and how fast it drove",
        "Beams.angle_min_rad": "which LiDAR it has",
        "Beams.angle_increment_rad": "which LiDAR it has",
        "Constraint.i": "nothing by itself",
        "Constraint.j": "nothing by itself",
        "Constraint.kind": "whether it came back to a place",
        "Constraint.t_i_j": "how it moved: speed and way",
        "Constraint.information": "how well its surroundings fix its pose: a bare corridor or a room",
        "Place.number": "where along its way this was seen",
        "Place.channel": "whether a camera or the LiDAR saw it",
        "Place.detector_version": "which network described it",
        "Place.first": "nothing by itself",
        "Place.last": "nothing by itself",
        "Place.count": "how much there is to see: a bare wall or full shelves",
        "Place.keypoints": "where corners and texture are, in metres; of a camera also how high: shelves, signs",
        "Place.descriptors": "256 bits of each spot's texture: enough to know it again, and to guess at what it is "
        "by many known images; no image, no colour",
        "WordPlace.number": "where along its way this was seen",
        "WordPlace.channel": "whether a camera or the LiDAR saw it",
        "WordPlace.detector_version": "which network described it",
        "WordPlace.first": "nothing by itself",
        "WordPlace.last": "nothing by itself",
        "WordPlace.count": "how much there is to see: a bare wall or full shelves",
        "WordPlace.keypoints": "where corners and texture are, in metres; of a camera also how high: shelves, signs",
        "WordPlace.words": "which of some thousand kinds of texture each spot has: less than a descriptor; no image",
        "MapTile.resolution_m": "nothing of the robot",
        "MapTile.column": "how large the area is",
        "MapTile.row": "how large the area is",
        "MapTile.cells": "the floor plan at the height of the LiDAR, as one map without times",
        "TagSighting.number": "where along its way this was seen",
        "TagSighting.family": "which tags the building has",
        "TagSighting.tag": "which tag it passed",
        "TagSighting.t_base_tag": "where the tag is",
        "TagSighting.information": "how far the tag was",
        "KeyscanFix.number": "where along its way it was measured",
        "KeyscanFix.latitude_deg": "where on the earth the robot was",
        "KeyscanFix.longitude_deg": "where on the earth the robot was",
        "KeyscanFix.altitude_m": "how high the robot was",
        "KeyscanFix.sigma_m": "how good its receiver is",
        "KeyscanFix.antenna_x_m": "nothing of the building",
        "KeyscanFix.antenna_y_m": "nothing of the building",
        "Correction.version": "how often the cloud's map has changed",
        "Correction.map_index": "whether the robot has met others",
        "Correction.t_map_odom": "where the robot is in the building's map",
        "Correction.quality": "how much of what it sees others have seen",
        "DetectorUpdate.channel": "nothing of the robot",
        "DetectorUpdate.version": "that the fleet has trained",
        "DetectorUpdate.format": "nothing of the robot",
        "DetectorUpdate.size": "nothing of the robot",
        "DetectorUpdate.sha256": "nothing of the robot",
        "Acknowledgement.epoch": "nothing by itself",
        "Acknowledgement.sequence": "how much the cloud has",
    }
)
"""By message and field of fcslam.proto; a test checks that the list is complete."""

PLAIN = frozenset({"Pose"})
"""Messages without a meaning of their own besides the field that holds them."""

_TYPES = {
    FieldDescriptor.TYPE_DOUBLE: "double",
    FieldDescriptor.TYPE_FLOAT: "float",
    FieldDescriptor.TYPE_UINT32: "uint32",
    FieldDescriptor.TYPE_UINT64: "uint64",
    FieldDescriptor.TYPE_SINT32: "sint32",
    FieldDescriptor.TYPE_STRING: "string",
    FieldDescriptor.TYPE_BYTES: "bytes",
}


@dataclass(frozen=True, slots=True)
class FieldDisclosure:
    """One field of one message."""

    name: str
    """Path of the field, as in ``detectors.version``."""
    type: str
    reveals: str


@dataclass(frozen=True, slots=True)
class Disclosure:
    """One kind of message, or the envelope of all messages."""

    name: str
    direction: str
    fields: tuple[FieldDisclosure, ...]


def disclosures() -> list[Disclosure]:
    """The envelope and every kind of message with all their fields, in the order of the schema."""
    envelope: Any = pb.Packet.DESCRIPTOR
    own = tuple(
        FieldDisclosure(field.name, _type(field), _reveals(field))
        for field in envelope.fields
        if field.containing_oneof is None
    )
    return [
        Disclosure("every packet", "both ways", own),
        *(_disclosure(field) for field in envelope.oneofs_by_name["body"].fields),
    ]


def _disclosure(body: Any) -> Disclosure:
    direction = "robot to cloud" if PacketKind(body.name) in UPLINK else "cloud to robot"
    return Disclosure(body.name, direction, tuple(_walk(body.message_type, "")))


def _walk(message: Any, prefix: str) -> Iterator[FieldDisclosure]:
    for field in message.fields:
        yield FieldDisclosure(prefix + field.name, _type(field), _reveals(field))
        if field.message_type is not None and field.message_type.name not in PLAIN:
            yield from _walk(field.message_type, f"{prefix}{field.name}.")


def _reveals(field: Any) -> str:
    return REVEALS[f"{field.containing_type.name}.{field.name}"]


def _type(field: Any) -> str:
    named = field.message_type or field.enum_type
    name = named.name if named is not None else _TYPES[field.type]
    return f"repeated {name}" if field.is_repeated else name
