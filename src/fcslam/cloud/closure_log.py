"""The log of all closures that were considered, with their status and its reason."""

from collections.abc import Iterable, Iterator
from copy import copy
from dataclasses import dataclass, fields, replace
from typing import ClassVar

from fcslam.places.matcher import PlaceMatch
from fcslam.records import (
    Channel,
    ClosureStatus,
    Constraint,
    FloatArray,
    KeyscanId,
    LoopClosure,
    ManualClosure,
    Reason,
    ReasonCode,
    Tag,
    frozen,
)
from fcslam.storage.snapshot import Kept
from fcslam.storage.state_file import State

MATCHER = "fleet.matcher"
"""Section of the configuration that holds the thresholds of place matching."""


@dataclass(slots=True, eq=False)
class ClosureEntry:
    """A closure and, once it is in the pose graph, its edge there."""

    closure: LoopClosure
    independent: bool
    """Whether it is evidence for the relative pose of two maps: not if the joint map predicted it."""
    edge: int | None = None
    vetoed: bool = False
    pinned: bool = False
    """Whether a user says that it is true; a veto outweighs this."""
    made_by_hand: ManualClosure | None = None
    """The edit that made it."""

    @property
    def is_certain(self) -> bool:
        """Whether it counts whatever the other evidence says."""
        return self.pinned and not self.vetoed

    @property
    def is_measured(self) -> bool:
        """Whether geometry measured T_i_j; if not, words alone say that both are the same place."""
        return bool(self.closure.information.any())

    @property
    def is_between(self) -> bool:
        """Whether it connects two robots."""
        return self.closure.i.robot != self.closure.j.robot

    def set(self, status: ClosureStatus, reason: Reason) -> None:
        """Change the status."""
        self.closure = replace(self.closure, status=status, reason=reason)


class ClosureLog(Kept):
    """Closures in the order in which they were found."""

    KEPT: ClassVar = {"_entries": list[ClosureEntry]}

    def __init__(self, entries: Iterable[ClosureEntry] = ()) -> None:
        """Start with copies of the entries of another log, in less time than from its ``state``."""
        self._entries: list[ClosureEntry] = []
        self._between: dict[frozenset[str], list[ClosureEntry]] = {}
        """Entries by pair of robots, because every place queries its pairs."""
        self._at: dict[str, dict[int, list[ClosureEntry]]] = {}
        """Verified entries between robots, by robot and keyscan of both ends; a candidate never changes its status."""
        for entry in entries:
            self._add(copy(entry))

    def __iter__(self) -> Iterator[ClosureEntry]:
        return iter(self._entries)

    def __len__(self) -> int:
        return len(self._entries)

    def confirms(self, match: PlaceMatch) -> bool:
        """Whether a closure between these two places was verified before.

        The same places seen by another detector are not independent evidence.
        """
        # Each sighting of a tag is a measurement of its own.
        return match.channel is not Channel.TAG and self.has(match.i, match.j, match.channel)

    def has(self, i: KeyscanId, j: KeyscanId, channel: Channel) -> bool:
        """Whether the log has a closure between these two places of a channel."""
        found = (entry.closure for entry in self._at.get(j.robot, {}).get(j.number, ()))
        return any({closure.i, closure.j} == {i, j} and closure.channel is channel for closure in found)

    def add(self, match: PlaceMatch) -> ClosureEntry:
        """Add a match, as verified or, if its verification failed, as a candidate."""
        closure = LoopClosure(*(getattr(match, each.name) for each in fields(LoopClosure)))
        closure = replace(closure, reason=match.reason.under(MATCHER))
        return self._add(ClosureEntry(closure, independent=not match.predicted))

    def add_local(self, constraint: Constraint, edge: int, tag: Tag | None = None) -> ClosureEntry:
        """Add a closure within a map, by its robot or a ``tag``; accepted until the joint graph contradicts it."""
        found = Reason(ReasonCode.FOUND_BY_ROBOT) if tag is None else Reason(ReasonCode.SAME_TAG, tag.number)
        i, j = KeyscanId(constraint.robot, constraint.i), KeyscanId(constraint.robot, constraint.j)
        channel = Channel.LIDAR if tag is None else Channel.TAG
        closure = LoopClosure(
            i, j, channel, 0.0, constraint.T_i_j, constraint.information, ClosureStatus.ACCEPTED, found, tag=tag
        )
        return self._add(ClosureEntry(closure, independent=False, edge=edge))

    def add_by_hand(
        self, made: ManualClosure, i: KeyscanId, j: KeyscanId, T_i_j: FloatArray, information: FloatArray
    ) -> ClosureEntry:
        """Add a user's own closure between two keyscans, with its pose (3,) and information (3, 3)."""
        reason = Reason(ReasonCode.MADE_BY_HAND)
        closure = LoopClosure(
            i, j, Channel.LIDAR, 0.0, frozen(T_i_j), frozen(information), ClosureStatus.VERIFIED, reason
        )
        return self._add(ClosureEntry(closure, independent=False, pinned=True, made_by_hand=made))

    def _add(self, entry: ClosureEntry) -> ClosureEntry:
        self._entries.append(entry)
        self._index(entry)
        return entry

    def _index(self, entry: ClosureEntry) -> None:
        if not entry.is_between:
            return
        i, j = entry.closure.i, entry.closure.j
        self._between.setdefault(frozenset((i.robot, j.robot)), []).append(entry)
        if entry.closure.status is not ClosureStatus.CANDIDATE:
            for place in (i, j):
                self._at.setdefault(place.robot, {}).setdefault(place.number, []).append(entry)

    def restore(self, state: State) -> None:
        """Take over a ``state``."""
        super().restore(state)
        for entry in self._entries:
            self._index(entry)

    def evidence(self, a: str, b: str) -> list[ClosureEntry]:
        """The verified closures between two robots that the joint map did not predict and no veto excludes."""
        return [
            entry
            for entry in self._between.get(frozenset((a, b)), ())
            if entry.independent
            and entry.is_measured
            and not entry.vetoed
            and entry.closure.status is not ClosureStatus.CANDIDATE
        ]

    def tied(self, robot: str) -> list[int]:
        """Numbers of the robot's keyscans with accepted closures to other robots, ascending."""
        return sorted(
            number
            for number, entries in self._at.get(robot, {}).items()
            if any(entry.closure.status is ClosureStatus.ACCEPTED for entry in entries)
        )
