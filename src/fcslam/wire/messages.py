"""A packet: one record in the envelope that orders and addresses it."""

from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum

from fcslam.records import Channel, Constraint, Correction, DetectorFile, Keyscan, LaserModel, Place


class PacketKind(StrEnum):
    """What a packet carries; the names of the fields of ``Packet.body`` in fcslam.proto."""

    HELLO = "hello"
    KEYSCAN = "keyscan"
    CONSTRAINT = "constraint"
    PLACE = "place"
    CORRECTION = "correction"
    ACKNOWLEDGEMENT = "acknowledgement"
    DETECTOR_UPDATE = "detector_update"


UPLINK = frozenset({PacketKind.HELLO, PacketKind.KEYSCAN, PacketKind.CONSTRAINT, PacketKind.PLACE})
"""What robots send; the other kinds come back from the cloud."""


@dataclass(frozen=True, slots=True)
class Hello:
    """How to read the packets that follow: the first of an epoch, and again whenever a detector has changed."""

    robot: str
    epoch: int
    laser: LaserModel
    detector_versions: Mapping[Channel, str]


@dataclass(frozen=True, slots=True)
class Acknowledgement:
    """What the cloud tells a robot: this packet is stored and need not be sent again."""

    robot: str
    epoch: int
    """Epoch of the packet acknowledged."""
    sequence: int
    """Its sequence number."""


@dataclass(frozen=True, slots=True)
class DetectorUpdate:
    """What the cloud tells a robot: there is a newer detector, to be fetched and used from then on."""

    robot: str
    file: DetectorFile


Body = Hello | Keyscan | Constraint | Place | Correction | Acknowledgement | DetectorUpdate


@dataclass(frozen=True, slots=True)
class Packet:
    """One record on its way between one robot and the cloud."""

    robot: str
    """Sender or, for what the cloud sends, addressee."""
    epoch: int
    """Grows with every start of the robot."""
    sequence: int
    """Counts the packets of one sender in one epoch from 0."""
    time: float
    """Seconds of the recording's own clock: the largest stamp that the robot had seen when it sent this."""
    body: Body

    @property
    def order(self) -> tuple[float, str, int, int]:
        """Key of the canonical order: by it a set of packets becomes one sequence, however they arrived."""
        return self.time, self.robot, self.epoch, self.sequence
