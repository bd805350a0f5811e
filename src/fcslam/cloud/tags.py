"""Tags that robots saw: two keyscans that saw the same tag are a closure, as two that match by their walls.

A tag seen in two sessions is a candidate of the joint map and passes the same decisions. Seen twice by one session, it
is a closure within its map. In both cases the joint graph may contradict it: the tag was moved, is there twice, or a
camera is calibrated wrongly.
"""

from collections import Counter
from collections.abc import Collection
from itertools import islice
from typing import ClassVar

import numpy as np

from fcslam.cloud.claims import check_sighting, with_least_noise
from fcslam.cloud.joint_graph import JointGraph
from fcslam.cloud.session_store import SessionStore
from fcslam.cloud.sessions import robot_of
from fcslam.errors import PacketError
from fcslam.geometry import se2
from fcslam.places.matcher import PlaceMatch
from fcslam.records import (
    Channel,
    ClosureStatus,
    Constraint,
    ConstraintKind,
    FloatArray,
    KeyscanId,
    Reason,
    ReasonCode,
    Tag,
    TagSighting,
    frozen,
)
from fcslam.storage.snapshot import Kept
from fcslam.storage.state_file import State
from fcslam.wire.limits import MAXIMUM_TAGS

MOST_SENDERS = 10
"""Robots, those that came to the tag last, whose newest session a new sighting is paired with."""
MOST_CLOSURES = 200
"""Closures by tags between two sessions: their cost grows with the square."""
REVISIT_M = 10.0
"""Path after which a session that sees a tag again has come back to it."""


class SeenTags(Kept):
    """The sightings of every tag, by session."""

    KEPT: ClassVar = {
        "_seen": dict[Tag, dict[str, dict[int, TagSighting]]],
        "_paired": dict[Tag, set[tuple[KeyscanId, str]]],
    }

    def __init__(self, sessions: SessionStore, graph: JointGraph) -> None:
        self._sessions = sessions
        self._graph = graph
        self._seen: dict[Tag, dict[str, dict[int, TagSighting]]] = {}
        self._paired: dict[Tag, set[tuple[KeyscanId, str]]] = {}
        """By tag, each keyscan and the one session with which it has a closure: errors of a sighting count once."""
        self._tags: Counter[KeyscanId] = Counter()
        self._ends: Counter[frozenset[str]] = Counter()
        """Ends of closures by tags between two sessions."""

    def add(self, sighting: TagSighting) -> list[PlaceMatch]:
        """Note a sighting; returns its closures with earlier ones."""
        self._sessions.require(sighting.id)
        check_sighting(sighting)
        session, number = sighting.id
        if number in self._seen.get(sighting.tag, {}).get(session, {}):
            raise PacketError(f"{session}: keyscan {number} saw tag {sighting.tag} before")
        if self._tags[sighting.id] >= MAXIMUM_TAGS:
            raise PacketError(f"{session}: keyscan {number} saw more than {MAXIMUM_TAGS} tags")
        seen = self._seen.setdefault(sighting.tag, {})
        own = seen.setdefault(session, {})
        newest: dict[str, str] = {}
        for name in reversed(seen):
            if name != session and self._sessions.floor(name) == self._sessions.floor(session):
                newest.setdefault(robot_of(name), name)
        chosen = [(name, seen[name].values()) for name in islice(newest.values(), MOST_SENDERS)]
        back_m = self._graph.travel_since(session)
        earlier = [one for k, one in own.items() if k < number and back_m[k] - back_m[number] >= REVISIT_M]
        paired = self._paired.setdefault(sighting.tag, set())
        matches = []
        for name, sightings in (*chosen, (session, earlier)):
            free = [one for one in sightings if (one.id, session) not in paired]
            pair = frozenset((session, name))
            if free and self._ends[pair] < 2 * MOST_CLOSURES:
                partner = max(free, key=lambda one: float(np.linalg.det(one.information)))
                paired |= {(partner.id, session), (sighting.id, name)}
                self._ends[pair] += 2
                matches.append(_match(partner, sighting))
        own[number] = sighting
        self._tags[sighting.id] += 1
        return matches

    def of(self, sessions: Collection[str]) -> tuple[TagSighting, ...]:
        """All sightings of these sessions, by tag."""
        return tuple(
            one
            for tag in sorted(self._seen)
            for session in sorted(self._seen[tag].keys() & set(sessions))
            for one in self._seen[tag][session].values()
        )

    def restore(self, state: State) -> None:
        """Take over a ``state``."""
        super().restore(state)
        every = [one for sessions in self._seen.values() for own in sessions.values() for one in own.values()]
        self._tags = Counter(one.id for one in every)
        self._ends = Counter(frozenset((one.robot, name)) for pairs in self._paired.values() for one, name in pairs)


def _match(i: TagSighting, j: TagSighting) -> PlaceMatch:
    T_i_j: FloatArray = frozen(se2.compose(i.T_base_tag, se2.inverse(j.T_base_tag)))
    moved = se2.adjoint(j.T_base_tag)
    covariance = moved @ (np.linalg.inv(i.information) + np.linalg.inv(j.information)) @ moved.T
    information = np.linalg.inv(0.5 * (covariance + covariance.T))
    robot, kind = j.id.robot, ConstraintKind.CLOSURE
    measured = Constraint(robot, 0, 1, kind, T_i_j, frozen(0.5 * (information + information.T)))
    information, reason = with_least_noise(measured).information, Reason(ReasonCode.SAME_TAG, j.tag.number)
    return PlaceMatch(i.id, j.id, Channel.TAG, 1.0, T_i_j, information, ClosureStatus.VERIFIED, reason, tag=j.tag)
