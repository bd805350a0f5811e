"""Every closure that was ever considered, how far it came and why."""

from collections.abc import Iterator
from dataclasses import dataclass, replace

from fcslam.places.matcher import PlaceMatch
from fcslam.records import Channel, ClosureStatus, Constraint, KeyscanId, LoopClosure, frozen


@dataclass(slots=True, eq=False)
class ClosureEntry:
    """A closure and, once it is in the pose graph, its edge there."""

    closure: LoopClosure
    independent: bool
    """Whether it is evidence of how two robots' maps lie: not where that was known and only borne out."""
    edge: int | None = None
    vetoed: bool = False

    @property
    def is_between(self) -> bool:
        """Whether it ties two robots, not two moments of one."""
        return self.closure.i.robot != self.closure.j.robot

    def set(self, status: ClosureStatus, reason: str) -> None:
        """Move on to another status."""
        self.closure = replace(self.closure, status=status, reason=reason)


class ClosureLog:
    """Closures in the order in which they were found."""

    def __init__(self) -> None:
        self._entries: list[ClosureEntry] = []
        self._between: dict[frozenset[str], list[ClosureEntry]] = {}
        """Entries between two robots, by these: a large fleet asks for its pairs again and again."""
        self._ties: dict[str, list[ClosureEntry]] = {}
        """Entries between each robot and others, without mere candidates: those never become more."""
        self._confirmed: set[tuple[frozenset[KeyscanId], Channel]] = set()
        """Pairs of places between which geometry has confirmed a closure, with its channel."""

    def __iter__(self) -> Iterator[ClosureEntry]:
        return iter(self._entries)

    def __len__(self) -> int:
        return len(self._entries)

    def confirms(self, match: PlaceMatch) -> bool:
        """Whether geometry has confirmed these two places before: described anew they are no second witness."""
        return (frozenset((match.i, match.j)), match.channel) in self._confirmed

    def add(self, match: PlaceMatch) -> ClosureEntry:
        """Book a match as verified or, if geometry does not confirm it, as a candidate."""
        status = ClosureStatus.VERIFIED if match.M else ClosureStatus.CANDIDATE
        if match.M:
            self._confirmed.add((frozenset((match.i, match.j)), match.channel))
        closure = LoopClosure(
            match.i, match.j, match.channel, match.similarity, frozen(match.check.T_a_b),
            frozen(match.check.information), status, match.check.reason, match.check.informative,
        )  # fmt: skip
        entry = ClosureEntry(closure, independent=not match.predicted)
        self._entries.append(entry)
        if entry.is_between:
            self._between.setdefault(frozenset((match.i.robot, match.j.robot)), []).append(entry)
            for robot in (match.i.robot, match.j.robot) if match.M else ():
                self._ties.setdefault(robot, []).append(entry)
        return entry

    def add_local(self, constraint: Constraint, edge: int) -> ClosureEntry:
        """Book a closure that a robot found within its own map; it holds until the joint graph contradicts it."""
        i, j = KeyscanId(constraint.robot, constraint.i), KeyscanId(constraint.robot, constraint.j)
        closure = LoopClosure(
            i, j, Channel.LIDAR, 0.0, constraint.T_i_j, constraint.information, ClosureStatus.ACCEPTED,
            "found by the robot",
        )  # fmt: skip
        entry = ClosureEntry(closure, independent=False, edge=edge)
        self._entries.append(entry)
        return entry

    def evidence(self, a: str, b: str) -> list[ClosureEntry]:
        """What geometry confirms between two robots without having known how they lie, and nobody vetoed."""
        return [
            entry
            for entry in self._between.get(frozenset((a, b)), ())
            if entry.independent and not entry.vetoed and entry.closure.status is not ClosureStatus.CANDIDATE
        ]

    def ties(self, robot: str) -> Iterator[ClosureEntry]:
        """What is accepted between a robot and others, the newest first."""
        entries = reversed(self._ties.get(robot, ()))
        return (entry for entry in entries if entry.closure.status is ClosureStatus.ACCEPTED)
