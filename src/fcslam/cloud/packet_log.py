"""The order in which packets take effect: that of arrival, but within a session that of the sequence numbers.

Every packet takes effect once. A packet that arrives early waits for those before it in its session. A refused packet
keeps its sequence number, so later packets take effect without it.
"""

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from typing import NamedTuple


class PacketNumber(NamedTuple):
    """Identity of a packet: its session and its number there."""

    session: str
    sequence: int


@dataclass(slots=True, eq=False)
class PacketLog:
    """Knows which packets arrived and which of them may take effect; the packets themselves are kept elsewhere."""

    _next: dict[str, int] = field(default_factory=dict)
    """By session the number of the first packet that did not take effect."""
    _waiting: dict[str, set[int]] = field(default_factory=dict)
    """By session the numbers that arrived and did not take effect."""
    _refused: set[PacketNumber] = field(default_factory=set)
    released: int = 0
    """How many packets took effect or were refused, with all those before them in their sessions."""
    _newest: tuple[float, str, int] = (-math.inf, "", 0)
    is_canonical: bool = True
    """Whether the packets arrived in the order of their times, as ``canonical`` would give them."""

    def __contains__(self, number: PacketNumber) -> bool:
        session, sequence = number
        taken = sequence < self._next.get(session, 0)
        return taken or sequence in self._waiting.get(session, ()) or number in self._refused

    @property
    def sessions(self) -> tuple[str, ...]:
        """Sessions with at least one packet, in the order in which they were first heard of."""
        return tuple(self._waiting)

    def add(self, number: PacketNumber, time_s: float) -> None:
        """Note that a packet arrived; its envelope says when its robot sent it."""
        if number in self:
            return
        order = time_s, *number
        self.is_canonical &= order > self._newest
        self._newest = max(order, self._newest)
        self._waiting.setdefault(number.session, set()).add(number.sequence)

    def refuse(self, number: PacketNumber) -> None:
        """Note that a packet has no effect; its number is used up."""
        self._waiting.setdefault(number.session, set())
        self._refused.add(number)

    def ready(self, session: str) -> Iterator[PacketNumber]:
        """The packets of a session that may take effect now.

        A packet has taken effect once the next one is asked for: if it fails before, it is given again.
        """
        waiting = self._waiting.get(session, set())
        while (sequence := self._next.get(session, 0)) in waiting or PacketNumber(session, sequence) in self._refused:
            if (number := PacketNumber(session, sequence)) not in self._refused:
                yield number
            waiting.discard(sequence)
            self._next[session] = sequence + 1
            self.released += 1

    def would_wait(self, numbers: Iterable[PacketNumber]) -> list[PacketNumber]:
        """Those of some packets that would have to wait for an earlier one if all of them arrived now."""
        following = dict(self._next)
        early: list[PacketNumber] = []
        for number in sorted(numbers):
            session, sequence = number
            if sequence > following.get(session, 0):
                early.append(number)
            else:
                following[session] = max(following.get(session, 0), sequence + 1)
        return early

    def next_sequence(self, session: str) -> int:
        """Number of the first packet of the session that is missing or did not take effect."""
        return self._next.get(session, 0)

    def waiting_count(self, session: str) -> int:
        """How many packets of the session wait for one before them."""
        return len(self._waiting.get(session, ()))

    def canonical(self, arrived: Iterable[tuple[float, PacketNumber]]) -> Iterator[PacketNumber]:
        """The packets that took effect, in the order that depends on the set of packets alone.

        ``arrived`` gives time and number of every packet that was added, in any order.
        """
        replay = PacketLog()
        replay._refused = self._refused
        for time_s, number in sorted(arrived):
            replay.add(number, time_s)
            yield from replay.ready(number.session)
