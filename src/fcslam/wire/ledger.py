"""Traffic between robots and cloud: packets and bytes by robot and kind."""

from dataclasses import dataclass, field

from fcslam.records import Channel
from fcslam.wire.messages import UPLINK, PacketKind
from fcslam.wire.packets import Label


@dataclass(frozen=True, slots=True)
class Traffic:
    """Packets and their bytes, without the overhead of the network."""

    count: int = 0
    bytes: int = 0

    def __add__(self, other: "Traffic") -> "Traffic":
        return Traffic(self.count + other.count, self.bytes + other.bytes)


@dataclass(slots=True)
class Ledger:
    """The traffic so far."""

    accepted: dict[Label, Traffic] = field(default_factory=dict)
    """By robot, kind and, for places, channel; the kind determines the direction."""

    def accept(self, label: Label, size: int) -> None:
        """Count a packet of ``size`` bytes that was accepted."""
        self.accepted[label] = self.accepted.get(label, Traffic()) + Traffic(1, size)

    def total(
        self, robot: str | None = None, kind: PacketKind | None = None, channel: Channel | None = None
    ) -> Traffic:
        """Accepted traffic, optionally of one robot, one kind, or the places of one channel."""
        chosen = (
            traffic
            for label, traffic in self.accepted.items()
            if robot in (None, label.robot) and kind in (None, label.kind) and channel in (None, label.channel)
        )
        return sum(chosen, Traffic())

    def uplink(self, robot: str) -> Traffic:
        """Packets that the cloud accepted from one robot."""
        return sum((self.total(robot, kind) for kind in UPLINK), Traffic())

    def downlink(self, robot: str) -> Traffic:
        """Data that the cloud sent to one robot."""
        return sum((self.total(robot, kind) for kind in PacketKind if kind not in UPLINK), Traffic())
