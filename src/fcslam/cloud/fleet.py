"""The cloud: packets of N robots in, one robust pose graph and the robots' corrections out (the paper's figure 1).

A plain object without a network. Robots stay in maps of their own until the evidence to join them is there; what
arrives later may still revoke it. ``finalize`` depends on the set of packets only, not on their arrival.
"""

from collections.abc import Callable, Iterator
from dataclasses import replace
from operator import itemgetter
from typing import NamedTuple

import numpy as np

from fcslam.cloud.closure_log import ClosureLedger, Entry
from fcslam.cloud.correction_quality import Support
from fcslam.cloud.fusion_strategy import FusionStrategy
from fcslam.cloud.joining import first_estimate, judge
from fcslam.cloud.joint_graph import JointGraph
from fcslam.cloud.journal import Journal
from fcslam.cloud.reevaluation import reconsider
from fcslam.cloud.result import FleetResult, Fusion, conclude, map_indices
from fcslam.cloud.rigid_fusion import fuse_rigidly
from fcslam.cloud.robots import RobotStore
from fcslam.cloud.sessions import in_session, robot_of, session_name
from fcslam.cloud.settings import FleetConfig
from fcslam.cloud.submaps import SubmapShelf
from fcslam.cloud.visits import Visit, visits_near
from fcslam.errors import PacketError
from fcslam.geometry import se2
from fcslam.places.matcher import PlaceMatch, PlaceMatcher
from fcslam.places.thinning import surplus_places
from fcslam.records import (
    Channel,
    ClosureStatus,
    Constraint,
    ConstraintKind,
    Correction,
    DetectorFile,
    FloatArray,
    Keyscan,
    KeyscanId,
    Place,
    Veto,
    frozen,
)
from fcslam.wire.messages import Acknowledgement, DetectorUpdate, Hello, Packet
from fcslam.wire.packets import decode, encode


class VocabularyState(NamedTuple):
    """How far one kind of words has grown."""

    channel: Channel
    detector_version: str
    words: int
    places: int
    """Those that can be found again."""


_Words = tuple[Channel, str]
"""Channel and detector version of places that can be compared."""

MORE_DOUBTS = 1.1
"""Growth of the number of closures after which a doubt that was dispelled is taken up again."""


class Fleet:
    """Receives packets; matches, verifies, joins, optimises."""

    def __init__(self, config: FleetConfig, seed: int, journal: Journal | None = None) -> None:
        """``journal`` keeps packets as they came, to be replayed; by default memory does."""
        self._config = config
        self._seed = seed
        self._journal = {} if journal is None else journal
        self._store = RobotStore()
        self._graph = JointGraph()
        self._ledger = ClosureLedger()
        self._support = Support(self._graph, config.surprise_m, config.surprise_rad)
        self._submaps = SubmapShelf(self._store, self._graph, config.submaps_kept)
        self._matchers: dict[_Words, PlaceMatcher] = {}
        """Words of different channels or detectors are never compared."""
        self._places: dict[tuple[_Words, str], list[KeyscanId]] = {}
        """By kind of words and robot."""
        self._maps: list[list[str]] = []
        """Robots by map; maps and the robots in them in the order in which they started."""
        self._vetoes: list[Veto] = []
        self._doubted = False
        """Whether evidence has turned against a join."""
        self._patience = 0
        """Closures up to which doubts wait: the same doubts soon again would be dispelled again."""
        self._releases: dict[Channel, DetectorFile] = {}
        """The newest detectors."""
        self._version = 0
        self._disturbed = False
        """Whether something but a packet left its mark on the graph."""

    def receive(self, data: bytes) -> list[bytes]:
        """Take in an encoded packet; returns encoded packets for its sender.

        Raises:
            PacketError: it is no valid packet, or does not fit what its robot sent before.
        """
        packet = decode(data)
        ours = in_session(packet)
        if not self._store.knows(ours):
            self._journal[ours.robot, ours.sequence] = data
        self._admit(ours, self._store.admit(ours))
        return self._replies(packet)

    def skip(self, robot: str, epoch: int, sequence: int) -> None:
        """The packet with this number was refused for good: its robot's next ones take effect without it."""
        self._admit(None, self._store.skip(session_name(robot, epoch), sequence))

    def finalize(self) -> FleetResult:
        """The result of all packets so far, in their canonical order.

        Replayed, unless they arrived in it and no earlier result left its mark on the graph.
        """
        if self._store.arrived_in_canonical_order and not self._disturbed:
            return self._conclude()
        replay = Fleet(self._config, self._seed)
        for veto in self._vetoes:
            replay.veto(veto)
        for robot, sequence in sorted(self._store.skipped):
            replay._admit(None, replay._store.skip(robot, sequence))
        for number in self._store.canonical():
            packet = in_session(decode(self._journal[number]))
            replay._admit(packet, replay._store.admit(packet))
        return replay._conclude()

    def estimate(self) -> FleetResult:
        """What is believed now, with nothing decided anew: quick, and live maps are made of it."""
        poses: dict[str, FloatArray] = {robot: frozen(self._graph.trajectory(robot)) for robot in self._store.robots}
        own: dict[str, FloatArray] = {robot: frozen(self._graph.chain(robot)) for robot in self._store.robots}
        fusion = Fusion(self._maps, poses, own, tuple(entry.closure for entry in self._ledger))
        return conclude(self._store, self._graph, self._ledger, fusion, self._version)

    def _conclude(self) -> FleetResult:
        self._disturbed = True
        fusion = self._reconsider()
        if self._config.fusion is not FusionStrategy.JOINT:
            fusion = fuse_rigidly(self._ledger, fusion.T_local_base, self._config.fusion)
        return conclude(self._store, self._graph, self._ledger, fusion, self._version)

    def veto(self, veto: Veto) -> None:
        """From now on these closures count for nothing; maps that only they held together part."""
        self._vetoes.append(veto)
        before = [entry for entry in self._ledger if not entry.vetoed]
        vetoed = [entry for entry in before if self._is_vetoed(entry)]
        if any(entry.closure.status is not ClosureStatus.CANDIDATE for entry in vetoed):
            self._disturbed = True
            self._reconsider()

    def corrections(self) -> tuple[Correction, ...]:
        """Where every session's odometry lies in its map, as believed now."""
        index = map_indices(self._maps)
        return tuple(self._correction(session, index[session]) for session in self._store.robots)

    def vocabularies(self) -> tuple[VocabularyState, ...]:
        """What is known of every kind of words."""
        return tuple(
            VocabularyState(channel, version, matcher.word_count, len(matcher))
            for (channel, version), matcher in self._matchers.items()
        )

    def announce(self, file: DetectorFile) -> None:
        """From now on robots that describe this channel are told of this detector, until they have taken it."""
        self._releases[file.channel] = file

    def closure_counts(self) -> dict[str, int]:
        """Closures so far by kind, for progress displays."""
        counts = {"within robots": 0, "between robots": 0}
        for entry in self._ledger:
            if entry.closure.status is ClosureStatus.ACCEPTED:
                counts["between robots" if entry.is_between else "within robots"] += 1
        return counts

    def _admit(self, packet: Packet | None, arriving: Iterator[Packet]) -> None:
        """Take a packet that has come, if it is one, and those that waited for it.

        Raises:
            PacketError: ``packet`` is refused. One that came early and proves wrong only now is forgotten: it is not
                its sender's fault that shows in this call, and sent again it is refused for itself.
        """
        for ready in arriving:
            try:
                self._take(ready)
            except Exception as error:
                self._store.withdraw(ready)  # what did not take effect must not count as received
                if ready is packet or not isinstance(error, PacketError):
                    raise
                return

    def _take(self, packet: Packet) -> None:
        """One packet's effect: figure 1 of the paper, cloud side.

        Raises:
            PacketError: it does not fit what its robot sent before; nothing has changed.
        """
        match packet.body:
            case Hello() as hello:
                self._store.greet(hello)
            case Keyscan() as keyscan:
                self._store.add_keyscan(keyscan)
                if keyscan.id.number == 0:
                    self._graph.start(keyscan.id.robot)
                    self._maps.append([keyscan.id.robot])
            case Constraint(kind=ConstraintKind.ODOMETRY) as motion:
                self._store.connect(motion)
                self._graph.extend(motion)
            case Constraint() as closure:
                self._store.require(KeyscanId(closure.robot, closure.i), KeyscanId(closure.robot, closure.j))
                self._add_local(closure)
            case Place() as place:
                self._store.add_place(place)
                self._add_place(place)  # place recognition and map fusion
            case Correction() | Acknowledgement() | DetectorUpdate():
                raise PacketError(f"{packet.robot}: a {type(packet.body).__name__} goes to a robot, not to the cloud")

    def _add_place(self, place: Place) -> None:
        """Match a place (Algorithm 1), judge what it brings, join maps, optimise."""
        matches: list[PlaceMatch] = []
        if self._config.join_maps and self._store.hold(place):
            words = place.channel, place.detector_version
            matcher = self._matcher(words)
            matches = matcher.match(place, self._predicted(place), self._is_stranger(place.id.robot))
            entries = [self._ledger.add(match) for match in matches if not self._ledger.confirms(match)]
            waiting = [entry for entry in entries if not self._is_vetoed(entry) and self._accept_or_wait(entry)]
            for other in dict.fromkeys(entry.closure.i.robot for entry in waiting):
                self._judge_pair(other, place.id.robot)
            self._places.setdefault((words, place.id.robot), []).append(place.id)
            self._thin(words, place.id.robot)
        # A robot alone needs no estimate before the end.
        if len(self._store.robots) > 1 and self._graph.is_due(self._config.solve_every):
            self._optimize()
        if self._doubted and len(self._ledger) >= self._patience:
            self._reconsider()
        self._support.weigh(matches, self._map_of(place.id.robot))

    def _thin(self, words: _Words, robot: str) -> None:
        """Forget the oldest places of a robot's sessions in one map where it has very many."""
        settings, matcher, mates = self._config.matcher, self._matchers[words], self._map_of(robot)
        if len(matcher) <= settings.most_nearby:
            return
        sessions = {session for session in mates if robot_of(session) == robot_of(robot)}
        ids = [i for i in matcher if i.robot in sessions]
        positions = np.array([self._graph.pose(i)[:2] for i in ids])
        for row in surplus_places(positions, settings.nearby_m, settings.most_nearby):
            matcher.forget(ids[row])

    def _forget(self, place: Place) -> None:
        """Let go of what only a place that is never compared again needs."""
        self._places[(place.channel, place.detector_version), place.id.robot].remove(place.id)
        self._submaps.drop(place)
        self._store.release(place)

    def _matcher(self, words: _Words) -> PlaceMatcher:
        if words not in self._matchers:
            rng = np.random.default_rng(self._seed)
            self._matchers[words] = PlaceMatcher(self._config.matcher, self._submaps.of, rng, self._forget)
        return self._matchers[words]

    def _predicted(self, place: Place) -> dict[KeyscanId, FloatArray]:
        """T_i_j of the nearest places of other sessions in the same map, one of a visit, so many of a robot."""
        pose, words = self._graph.pose(place.id), (place.channel, place.detector_version)
        visits: dict[str, list[Visit]] = {}
        for session in self._map_of(place.id.robot):
            ids = self._places.get((words, session), []) if session != place.id.robot else []
            poses = np.array([self._graph.pose(i) for i in ids]).reshape(-1, 3)
            visits.setdefault(robot_of(session), []).extend(visits_near(ids, poses, pose[:2], self._config.sight_m))
        nearest = (sorted(found, key=itemgetter(0))[: self._config.near_visits] for found in visits.values())
        return {i: se2.between(self._graph.pose(i), pose) for found in nearest for _, i in found}

    def _is_stranger(self, robot: str) -> Callable[[KeyscanId], bool]:
        """Whether a place belongs to a robot in another map than ``robot``."""
        known = frozenset(self._map_of(robot))
        return lambda place: place.robot not in known

    def _map_of(self, robot: str) -> list[str]:
        """The robots that share a map with this one, itself included."""
        return next(robots for robots in self._maps if robot in robots)

    def _is_vetoed(self, entry: Entry) -> bool:
        """Ask the vetoes, and write down what they say."""
        i, j = entry.closure.i, entry.closure.j
        stamps = self._store.stamp(i), self._store.stamp(j)
        entry.vetoed |= any(veto.forbids(i.robot, stamps[0], j.robot, stamps[1]) for veto in self._vetoes)
        return entry.vetoed

    def _accept_or_wait(self, entry: Entry) -> bool:
        """Accept what fits the joint map; tells whether it waits, since only a cluster may accept it."""
        closure = entry.closure
        if closure.status is not ClosureStatus.VERIFIED:
            return False
        if closure.i.robot in self._map_of(closure.j.robot):
            off = self._graph.innovation(closure.i, closure.j, closure.T_i_j)
            if np.hypot(off[0], off[1]) < self._config.surprise_m and abs(off[2]) < self._config.surprise_rad:
                self._accept(entry, "fits the joint map")
                return False
        entry.independent = True  # the map did not predict this
        return True

    def _judge_pair(self, a: str, b: str) -> None:
        """Join two robots' maps, or add to their link, if one cluster of closures dominates."""
        entries = self._ledger.evidence(a, b)
        verdict = judge(entries, (a, b), self._graph, self._config.consistency)
        joined = b in self._map_of(a)
        members = [entries[k] for k in verdict.members]
        self._doubted |= joined and verdict.contested
        if not verdict.dominant:
            for entry in entries:
                if entry.closure.status is ClosureStatus.VERIFIED:
                    entry.set(ClosureStatus.VERIFIED, verdict.reason)
            return
        if not joined:
            self._join(members, a, b)
        reason = f"in the dominant cluster of {len(members)} closures ({verdict.separate_places} places apart)"
        fresh = [entry for entry in members if entry.closure.status is not ClosureStatus.ACCEPTED]
        for entry in fresh:
            self._accept(entry, reason)
        for entry in entries:
            if entry.closure.status is ClosureStatus.VERIFIED:
                entry.set(ClosureStatus.VERIFIED, "outside the dominant cluster")
        if fresh:
            self._optimize()

    def _join(self, members: list[Entry], a: str, b: str) -> None:
        """Move the younger map into the older one's frame."""
        older, younger = self._map_of(a), self._map_of(b)
        T_a_b = first_estimate(members, (a, b), self._graph, self._config.consistency)
        if self._maps.index(older) > self._maps.index(younger):
            older, younger, T_a_b = younger, older, se2.inverse(T_a_b)
        self._graph.move(younger, T_a_b)
        self._maps.remove(younger)
        older.extend(younger)
        older.sort(key=self._store.robots.index)

    def _accept(self, entry: Entry, reason: str) -> None:
        closure = entry.closure
        if entry.edge is None:
            entry.edge = self._graph.close(closure.i, closure.j, closure.T_i_j, closure.information)
        self._graph.count(entry.edge, holds=True)
        entry.set(ClosureStatus.ACCEPTED, reason)

    def _add_local(self, closure: Constraint) -> None:
        """A closure that a robot found within its own map."""
        i, j = KeyscanId(closure.robot, closure.i), KeyscanId(closure.robot, closure.j)
        edge = self._graph.close(i, j, closure.T_i_j, closure.information)
        if self._is_vetoed(self._ledger.add_local(closure, edge)):
            self._graph.count(edge, holds=False)

    def _optimize(self) -> None:
        self._graph.optimize()
        self._version += 1

    def _reconsider(self) -> Fusion:
        """Decide every closure anew: revoke what is outvoted, part the maps that only that held together."""
        fusion = reconsider(self._graph, self._ledger, self._config.consistency)
        self._maps = [list(robots) for robots in fusion.maps]
        self._doubted, self._patience = False, int(MORE_DOUBTS * len(self._ledger))
        self._version += 1
        return fusion

    def _replies(self, packet: Packet) -> list[bytes]:
        """Acknowledgement; after a place, where the robot's odometry lies in the map; newer detectors."""
        robot, epoch, session = packet.robot, packet.epoch, session_name(packet.robot, packet.epoch)
        bodies: list[Acknowledgement | Correction | DetectorUpdate] = [Acknowledgement(robot, epoch, packet.sequence)]
        if isinstance(packet.body, Place) and self._graph.keyscan_count(session):
            bodies.append(replace(self._correction(session, map_indices(self._maps)[session]), robot=robot))
        if isinstance(packet.body, Hello | Place):
            bodies += [DetectorUpdate(robot, file) for file in self._newer_detectors(session)]
        first = self._store.number_replies(session, len(bodies))
        return [encode(Packet(robot, epoch, first + k, packet.time, body)) for k, body in enumerate(bodies)]

    def _correction(self, session: str, map_index: int) -> Correction:
        quality = self._support.quality(session, self._map_of(session), self._ledger)
        return Correction(session, self._version, map_index, frozen(self._graph.T_map_odom(session)), quality)

    def _newer_detectors(self, session: str) -> list[DetectorFile]:
        """Of the channels that the robot has."""
        versions = self._store.detector_versions(session)
        newest = self._releases.items()
        return [file for channel, file in newest if versions.get(channel, file.version) != file.version]
