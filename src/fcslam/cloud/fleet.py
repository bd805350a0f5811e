"""The fleet: packets of N robots in, one robust pose graph and the robots' corrections out (the paper's figure 1).

A plain object without a network. Robots stay in maps of their own until the evidence to join them is conclusive; later
evidence may revoke a join. ``finalize`` depends on the set of packets only, not on their order.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from typing import Any, Self

from fcslam.cloud.claims import LONGEST_CLOSURE_M, check_constraint, check_submap, with_least_noise
from fcslam.cloud.closure_log import ClosureEntry, ClosureLog
from fcslam.cloud.correction_quality import CorrectionQuality
from fcslam.cloud.decisions import ClosureDecisions
from fcslam.cloud.edits import floors, is_removed, needs_new_fleet
from fcslam.cloud.joint_graph import JointGraph
from fcslam.cloud.packet_log import PacketLog, PacketNumber
from fcslam.cloud.placement import T_placed_map
from fcslam.cloud.recognition import PlaceRecognition, VocabularyState
from fcslam.cloud.result import FleetResult, Fusion, conclude, map_indices
from fcslam.cloud.rigid_fusion import fuse_rigidly
from fcslam.cloud.session_store import SessionStore
from fcslam.cloud.sessions import in_session
from fcslam.cloud.settings import FleetConfig, FusionStrategy
from fcslam.cloud.space import Space
from fcslam.cloud.tags import SeenTags
from fcslam.errors import PacketError
from fcslam.geometry import se2
from fcslam.lidar.pair_verification import VerifyPairs, verify_here
from fcslam.records import (
    Change,
    ClosureStatus,
    Constraint,
    ConstraintKind,
    Correction,
    FloatArray,
    Keyscan,
    KeyscanFix,
    KeyscanId,
    ManualClosure,
    Place,
    TagSighting,
    VoxelMap,
    frozen,
)
from fcslam.storage.state_file import State
from fcslam.wire.messages import Acknowledgement, DetectorUpdate, Hello, Packet


class Fleet:
    """Applies packets; place recognition and decisions about closures have classes of their own."""

    def __init__(
        self,
        config: FleetConfig,
        seed: int,
        verify_pairs: VerifyPairs = verify_here,
        read: Callable[[PacketNumber], Packet] | None = None,
    ) -> None:
        """Start without packets.

        ``verify_pairs`` verifies pairs of submaps, here or on a pool; ``read`` gives packets by number.
        """
        self._config = config
        self._verify_pairs = verify_pairs
        self._seed = seed
        self._sessions = SessionStore(config.claims, read)
        self._graph = JointGraph(config.group)
        self._space = Space(config.group, self._sessions)
        self._decisions = ClosureDecisions(config, self._sessions, self._graph, self._space)
        self._recognition = PlaceRecognition(
            config, seed, self._sessions, self._graph, self._space, self._decisions.closures, verify_pairs
        )
        self._tags = SeenTags(self._sessions, self._graph)
        self._quality = CorrectionQuality(self._graph)
        self._needs_replay = False
        """Whether something besides the packets changed the graph: an edit."""
        self._replayed: tuple[list[PacketNumber], State] | None = None
        """Order and state of the replay of the last result, which the next one goes on from."""

    def apply(self, packet: Packet) -> None:
        """Let one packet take effect: figure 1 of the paper, cloud side.

        ``PacketLog`` gives the packets of a session in the order of their numbers. A removed session has no effect.

        Raises:
            PacketError: it does not fit what its robot sent before; nothing has changed.
        """
        packet = in_session(packet)
        if is_removed(packet.robot, self._decisions.changes):
            return
        match packet.body:
            case Hello() as hello:
                self._sessions.add_hello(hello, packet.sequence)
            case Keyscan() as keyscan:
                self._add_keyscan(keyscan, packet.sequence)
            case Constraint(kind=ConstraintKind.ODOMETRY):
                motion = self._space.constraint(packet.body)
                self._sessions.add_motion(motion)
                self._graph.extend(with_least_noise(motion))
            case Constraint():
                closure = self._space.constraint(packet.body)
                self._sessions.require(KeyscanId(closure.robot, closure.i), KeyscanId(closure.robot, closure.j))
                check_constraint(closure, LONGEST_CLOSURE_M)
                self._decisions.add_local(with_least_noise(closure))
            case Place() as place:
                self._add_place(place)  # place recognition and map fusion
            case TagSighting() as sighting:
                self._add_sighting(sighting)
            case KeyscanFix() as fix:
                self._sessions.add_fix(fix)
            case VoxelMap() as voxels:
                self._sessions.add_voxel_map(voxels, packet.sequence)
            case Correction() | Acknowledgement() | DetectorUpdate():
                raise PacketError(f"{packet.robot}: a {type(packet.body).__name__} goes to a robot, not to the cloud")

    def state(self) -> State:
        """The state after the packets so far, without what those hold; ``restored`` makes an equal fleet of it."""
        return {"needs_replay": self._needs_replay, **{name: part.state() for name, part in self._parts().items()}}

    def _parts(self) -> dict[str, Any]:
        return {
            "sessions": self._sessions,
            "graph": self._graph,
            "closures": self._decisions.closures,
            "comparison": self._decisions.comparison,
            "decisions": self._decisions,
            "recognition": self._recognition,
            "tags": self._tags,
            "quality": self._quality,
        }

    @classmethod
    def restored(
        cls,
        config: FleetConfig,
        seed: int,
        state: State,
        read: Callable[[PacketNumber], Packet],
        verify_pairs: VerifyPairs = verify_here,
        changes: Sequence[Change] = (),
    ) -> Self:
        """The fleet of a ``state`` under the same configuration and seed, and the same changes by hand in force.

        ``read`` gives the packets that it applied; the fleet reads keyscans when it needs them.
        """
        fleet = cls(config, seed, verify_pairs, read)
        fleet._decisions.changes = tuple(changes)
        fleet._sessions.name_floors(floors(changes))
        for name, part in fleet._parts().items():
            part.restore(state[name])
        fleet._needs_replay = state["needs_replay"]
        return fleet

    def edit(self, changes: Sequence[Change]) -> None:
        """Replace the changes by hand that are in force; maps that only excluded closures joined are separated.

        A removed session leaves the estimate and is compared with nothing, but stays in memory.

        Raises:
            ValueError: a removed session comes back or one changes its floor; only a new fleet can apply its packets.
        """
        if self._sessions.robots and needs_new_fleet(self._decisions.changes, changes):
            raise ValueError("a removed session cannot come back, and none can change its floor")
        self._sessions.name_floors(floors(changes))
        removed = [session for session in self._sessions.robots if is_removed(session, changes)]
        # A closure by hand comes after all others, in this fleet perhaps before some.
        made = bool(self._sessions.robots) and any(isinstance(change, ManualClosure) for change in changes)
        self._needs_replay |= self._decisions.edit(changes) or bool(removed) or made
        self._recognition.forget(removed)
        self._compare_separated()
        self._replayed = None

    def read_ahead(self, most: int) -> bool:
        """After ``restored``: load up to ``most`` keyscans before ``estimate`` needs them; False: all are loaded."""
        return self._sessions.read_ahead(most)

    def estimate(self) -> FleetResult:
        """The current estimate, without a new decision: quick, for live maps."""
        sessions = self._present()
        poses: dict[str, FloatArray] = {session: frozen(self._graph.trajectory(session)) for session in sessions}
        own: dict[str, FloatArray] = {session: frozen(self._graph.chain(session)) for session in sessions}
        entries = self._present_closures()
        fusion = self._rigid_fusion() or Fusion(
            self._present_maps(),
            poses,
            own,
            tuple(entry.closure for entry in entries),
            {pair: evidence for pair, evidence in self._decisions.joins.items() if pair <= set(sessions)},
        )
        return conclude(self._sessions, self._graph, entries, fusion, self._decisions.changes)

    def conclude(self) -> FleetResult:
        """Decide every closure from all evidence and collect the result; the fleet stays as it is."""
        graph = JointGraph(self._graph.group)
        graph.restore(self._graph.state())
        decisions = ClosureDecisions(self._config, self._sessions, graph, self._space)
        decisions.changes = self._decisions.changes
        decisions.closures = ClosureLog(self._decisions.closures)
        decisions.comparison.restore(self._decisions.comparison.state())
        decisions.restore(self._decisions.state())
        fusion = decisions.reevaluate(final=True)
        if self._config.fusion is not FusionStrategy.JOINT:
            fusion = fuse_rigidly(decisions.closures, fusion.T_local_base)
        result = conclude(self._sessions, graph, decisions.closures, fusion, decisions.changes)
        return replace(result, sightings=self._tags.of(self._present()))

    def finalize(
        self, log: PacketLog, arrived: Iterable[tuple[float, PacketNumber]], read: Callable[[PacketNumber], Packet]
    ) -> FleetResult:
        """The result of all packets in canonical order, without those of removed sessions.

        Unless they came in this order, another fleet applies them: all, or those after an earlier result, if all of
        these come later in the order. ``log`` is the order in which this fleet applied its packets; ``arrived`` has
        time and number of each, in any order.
        """
        if log.is_canonical and not self._needs_replay:
            return self.conclude()
        changes, done = self._decisions.changes, 0
        order = [number for number in log.canonical(arrived) if not is_removed(number.session, changes)]
        replayed, self._replayed = self._replayed, None
        if replayed is not None and order[: len(replayed[0])] == replayed[0]:
            done = len(replayed[0])
            replay = Fleet.restored(self._config, self._seed, replayed[1], read, self._verify_pairs, changes)
        else:
            replay = Fleet(self._config, self._seed, self._verify_pairs)
            replay.edit(changes)
        for number in order[done:]:
            replay.apply(read(number))
        self._replayed = order, replay.state()
        return replay.conclude()

    def corrections(self, *chosen: str) -> tuple[Correction, ...]:
        """Where the odometry of sessions lies in their maps by now: of all, or of those chosen; not of removed ones."""
        rigid = self._rigid_fusion()
        indices = map_indices(rigid.maps if rigid else self._present_maps())
        sessions = (session for session in chosen or self._present() if session in indices)
        return tuple(self._correction(session, indices[session], rigid) for session in sessions)

    def vocabularies(self) -> tuple[VocabularyState, ...]:
        """The state of every vocabulary."""
        return self._recognition.vocabularies()

    def closure_counts(self) -> dict[str, int]:
        """Accepted closures so far, by kind."""
        entries = self._decisions.closures
        accepted = [entry.is_between for entry in entries if entry.closure.status is ClosureStatus.ACCEPTED]
        return {"within robots": accepted.count(False), "between robots": accepted.count(True)}

    def _present(self) -> list[str]:
        return [session for session in self._sessions.robots if not is_removed(session, self._decisions.changes)]

    def _present_maps(self) -> list[list[str]]:
        return [map_ for map_ in self._decisions.maps if not is_removed(map_[0], self._decisions.changes)]

    def _present_closures(self) -> list[ClosureEntry]:
        present = set(self._present())
        return [e for e in self._decisions.closures if {e.closure.i.robot, e.closure.j.robot} <= present]

    def _rigid_fusion(self) -> Fusion | None:
        if self._config.fusion is FusionStrategy.JOINT:
            return None
        poses = {session: self._graph.trajectory(session) for session in self._present()}
        own: dict[str, FloatArray] = {session: frozen(se2.between(T[0], T)) for session, T in poses.items()}
        return fuse_rigidly(self._present_closures(), own)

    def _correction(self, session: str, map_index: int, rigid: Fusion | None) -> Correction:
        quality = self._quality.of(session, self._decisions.map_of(session), self._decisions.closures)
        changes, pose_of = self._decisions.changes, self._graph.pose
        members: Sequence[str] = self._decisions.map_of(session)
        T_map_odom = self._graph.T_map_odom(session)
        if rigid:
            members = next(robots for robots in rigid.maps if session in robots)
            pose_of = rigid.pose
            T_map_odom = self._graph.T_map_odom(session, rigid.T_map_base[session][-1])
        group = self._graph.group
        T = T_placed_map(members, self._sessions, pose_of, changes, group)
        T_map_odom = frozen(T_map_odom if T is None else group.compose(T, T_map_odom))
        return Correction(session, self._decisions.version, map_index, T_map_odom, quality)

    def _add_keyscan(self, keyscan: Keyscan, sequence: int) -> None:
        self._sessions.add_keyscan(keyscan, sequence)
        if keyscan.id.number == 0:
            self._graph.start(keyscan.id.robot)
            self._decisions.maps.append([keyscan.id.robot])

    def _add_sighting(self, sighting: TagSighting) -> None:
        session = sighting.id.robot
        matches = [self._space.match(match) for match in self._tags.add(sighting)]
        for match in matches:
            if match.i.robot == session:
                constraint = Constraint(
                    session, match.i.number, match.j.number, ConstraintKind.CLOSURE, match.T_i_j, match.information
                )
                self._decisions.add_local(constraint, match.tag)
        if self._config.join_maps:
            self._decisions.add_matches((match for match in matches if match.i.robot != session), session)
        self._optimize_if_due()

    def _add_place(self, place: Place) -> None:
        session, decisions = place.id.robot, self._decisions
        self._sessions.require(place.id, KeyscanId(session, place.last))
        check_submap(place, self._graph.chain(session, place.first, place.last))
        self._sessions.add_place(place)
        is_compared = self._config.join_maps and self._sessions.hold(place)
        matches = self._recognition.match(place, decisions.map_of(session)) if is_compared else []
        decisions.add_matches(matches, session)
        self._optimize_if_due()
        if is_compared:
            self._recognition.thin(place, decisions.map_of(session))
        self._quality.update(place, matches, decisions.map_of(session))

    def _optimize_if_due(self) -> None:
        """Solve, and compare the places of maps that this separated: a false joint map predicts wrong pairs."""
        self._decisions.optimize_if_due()
        self._compare_separated()

    def _compare_separated(self) -> None:
        while self._decisions.separated:
            for session, matches in self._recognition.match_again(*self._decisions.separated.pop()):
                self._decisions.add_matches(matches, session)
