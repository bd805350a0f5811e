"""A packet: one record in the envelope that orders and addresses it."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from enum import StrEnum

from fcslam.records import (
    Channel,
    Constraint,
    Correction,
    DetectorFile,
    Keyscan,
    KeyscanFix,
    LaserModel,
    Place,
    TagSighting,
    VoxelMap,
)


class PacketKind(StrEnum):
    """Kind of record in a packet; the names of the fields of ``Packet.body`` in fcslam.proto."""

    HELLO = "hello"
    KEYSCAN = "keyscan"
    CONSTRAINT = "constraint"
    PLACE = "place"
    TAG_SIGHTING = "tag_sighting"
    KEYSCAN_FIX = "keyscan_fix"
    VOXEL_MAP = "voxel_map"
    CORRECTION = "correction"
    ACKNOWLEDGEMENT = "acknowledgement"
    DETECTOR_UPDATE = "detector_update"


UPLINK = frozenset(PacketKind) - {PacketKind.CORRECTION, PacketKind.ACKNOWLEDGEMENT, PacketKind.DETECTOR_UPDATE}
"""Kinds that robots send; the cloud sends the others."""


@dataclass(frozen=True, slots=True)
class Hello:
    """Describes the packets that follow: first in an epoch, repeated with a new detector or one more laser."""

    robot: str
    epoch: int
    lasers: tuple[LaserModel, ...]
    """One or more; keyscans name theirs by its index."""
    detector_versions: Mapping[Channel, str]
    floor: str = ""
    """Floor of the building that the session maps, the same in all hellos of an epoch; empty: not named."""


@dataclass(frozen=True, slots=True)
class Acknowledgement:
    """From cloud to robot: a packet is stored and need not be sent again."""

    robot: str
    epoch: int
    """Epoch of the packet acknowledged."""
    sequence: int
    """Its sequence number."""


@dataclass(frozen=True, slots=True)
class DetectorUpdate:
    """From cloud to robot: a newer detector to download and use from then on."""

    robot: str
    file: DetectorFile


Body = (
    Hello
    | Keyscan
    | Constraint
    | Place
    | TagSighting
    | KeyscanFix
    | VoxelMap
    | Correction
    | Acknowledgement
    | DetectorUpdate
)


@dataclass(frozen=True, slots=True)
class Packet:
    """One record between a robot and the cloud, in its envelope."""

    robot: str
    """Sender; of a packet from the cloud, recipient."""
    epoch: int
    """Grows with every start of the robot."""
    sequence: int
    """Counts the packets of one sender in one epoch from 0."""
    time: float
    """Seconds of the recording's own clock: the largest stamp that the robot had seen when it sent this."""
    body: Body

    @property
    def order(self) -> tuple[float, str, int, int]:
        """Key of the canonical order, which does not depend on the order of arrival."""
        return self.time, self.robot, self.epoch, self.sequence

    def on_floor(self, floor: str) -> "Packet":
        """A hello that names the floor; any other packet as it is."""
        return replace(self, body=replace(self.body, floor=floor)) if isinstance(self.body, Hello) else self
