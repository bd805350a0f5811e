"""How encoded packets get to the cloud; the network is an argument."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

from fcslam.errors import PacketError
from fcslam.wire.ledger import Counter, Ledger
from fcslam.wire.packets import read_label

Handler = Callable[[bytes], Sequence[bytes]]
"""The receiving side: takes one encoded packet, gives encoded packets for its sender, refuses by PacketError."""


@dataclass(frozen=True, slots=True)
class Reply:
    """What came of a packet that reached the other side."""

    packets: tuple[bytes, ...] = ()
    """Encoded packets for the sender."""
    refusal: str | None = None
    """Why the packet was refused; it will be again, so sending it once more is of no use."""


class Transport(Protocol):
    """The sending side."""

    def send(self, data: bytes) -> Reply:
        """Hand over one encoded packet and wait for what comes back."""


class InMemoryTransport:
    """Sender and receiver in one process; packets still travel as bytes, so the ledger is what a network carries."""

    def __init__(self, handler: Handler) -> None:
        self._handler = handler
        self._counter = Counter()

    def send(self, data: bytes) -> Reply:
        """Hand ``data`` to the handler; a PacketError becomes a refusal, any other error is the caller's."""
        try:
            label = read_label(data)
            packets = tuple(self._handler(data))
        except PacketError as error:
            self._counter.refuse(len(data))
            return Reply(refusal=str(error))
        self._counter.accept(label, len(data))
        for packet in packets:
            self._counter.accept(read_label(packet), len(packet))
        return Reply(packets)

    def ledger(self) -> Ledger:
        """The traffic so far, in both directions."""
        return self._counter.ledger()
