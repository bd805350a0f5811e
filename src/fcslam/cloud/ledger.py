"""Every closure between robots that was ever considered, how far it came and why."""

from collections.abc import Iterator
from dataclasses import dataclass, replace

from fcslam.records import Channel, ClosureStatus, LoopClosure, frozen
from fcslam.places.matcher import PlaceMatch


@dataclass(slots=True)
class Entry:
    """A closure and, once it is in the pose graph, its edge there."""

    closure: LoopClosure
    predicted: bool
    edge: int | None = None

    def set(self, status: ClosureStatus, reason: str) -> None:
        """Move on to another status."""
        self.closure = replace(self.closure, status=status, reason=reason)


class ClosureLedger:
    """Closures between robots in the order in which they were found."""

    def __init__(self) -> None:
        self._entries: list[Entry] = []

    def __iter__(self) -> Iterator[Entry]:
        return iter(self._entries)

    def add(self, match: PlaceMatch) -> Entry:
        """Book a match as verified or, if geometry does not confirm it, as a candidate."""
        status = ClosureStatus.VERIFIED if match.M else ClosureStatus.CANDIDATE
        closure = LoopClosure(
            match.i, match.j, Channel.LIDAR, match.similarity, frozen(match.check.T_a_b),
            frozen(match.check.information), status, match.check.reason, match.check.informative,
        )  # fmt: skip
        entry = Entry(closure, match.predicted)
        self._entries.append(entry)
        return entry

    def between(self, a: str, b: str) -> list[Entry]:
        """Entries confirmed by geometry between two robots."""
        pair = {a, b}
        return [
            entry
            for entry in self._entries
            if entry.closure.status is not ClosureStatus.CANDIDATE
            and {entry.closure.i.robot, entry.closure.j.robot} == pair
        ]

    def accepted_edges(self) -> list[int]:
        """Edges of the closures that hold at present."""
        return [
            entry.edge
            for entry in self._entries
            if entry.edge is not None and entry.closure.status is ClosureStatus.ACCEPTED
        ]
