"""Every closure that was ever considered, how far it came and why."""

from collections.abc import Iterator
from dataclasses import dataclass, replace

from fcslam.places.matcher import PlaceMatch
from fcslam.records import Channel, ClosureStatus, Constraint, KeyscanId, LoopClosure, frozen


@dataclass(slots=True, eq=False)
class Entry:
    """A closure and, once it is in the pose graph, its edge there."""

    closure: LoopClosure
    predicted: bool
    edge: int | None = None

    @property
    def is_between(self) -> bool:
        """Whether it ties two robots, not two moments of one."""
        return self.closure.i.robot != self.closure.j.robot

    def set(self, status: ClosureStatus, reason: str) -> None:
        """Move on to another status."""
        self.closure = replace(self.closure, status=status, reason=reason)


class ClosureLedger:
    """Closures in the order in which they were found."""

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

    def add_local(self, constraint: Constraint, edge: int) -> None:
        """Book a closure that a robot found within its own map; it holds until the joint graph contradicts it."""
        i, j = KeyscanId(constraint.robot, constraint.i), KeyscanId(constraint.robot, constraint.j)
        closure = LoopClosure(
            i, j, Channel.LIDAR, 0.0, constraint.T_i_j, constraint.information, ClosureStatus.ACCEPTED,
            "found by the robot",
        )  # fmt: skip
        self._entries.append(Entry(closure, predicted=True, edge=edge))

    def between(self, a: str, b: str) -> list[Entry]:
        """Entries confirmed by geometry between two robots."""
        pair = {a, b}
        return [
            entry
            for entry in self._entries
            if entry.closure.status is not ClosureStatus.CANDIDATE
            and {entry.closure.i.robot, entry.closure.j.robot} == pair
        ]

    def joined(self) -> list[tuple[str, str]]:
        """Pairs of robots between whom closures hold at present."""
        pairs = [
            (min(c.i.robot, c.j.robot), max(c.i.robot, c.j.robot))
            for c in (entry.closure for entry in self._entries if entry.is_between)
            if c.status is ClosureStatus.ACCEPTED
        ]
        return list(dict.fromkeys(pairs))

    def accepted_edges(self) -> list[int]:
        """Edges of the closures that hold at present."""
        return self._edges(ClosureStatus.ACCEPTED)

    def revoked_edges(self) -> list[int]:
        """Edges of the closures that did once."""
        return self._edges(ClosureStatus.REVOKED)

    def _edges(self, status: ClosureStatus) -> list[int]:
        return [e.edge for e in self._entries if e.edge is not None and e.closure.status is status]
