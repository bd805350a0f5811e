"""Decisions about closures as they arrive: which are accepted, and which maps they join.

``joining.reevaluate`` decides all of them again for the final result. The rule itself is ``graph.evidence.shortfall``.
"""

from collections.abc import Iterable, Sequence
from dataclasses import replace
from functools import partial
from itertools import combinations
from typing import ClassVar

import numpy as np

from fcslam.cloud.closure_log import ClosureEntry, ClosureLog
from fcslam.cloud.edits import is_cut, is_removed, stamps_of
from fcslam.cloud.joining import CONSISTENCY, decide_join, reevaluate
from fcslam.cloud.joint_graph import AGREES_SIGMAS, SOLVED_SHARE, JointGraph
from fcslam.cloud.map_comparison import GROWTH, MapComparison
from fcslam.cloud.result import Fusion
from fcslam.cloud.session_store import SessionStore
from fcslam.cloud.settings import FleetConfig
from fcslam.cloud.space import Space
from fcslam.geometry import se2
from fcslam.graph.cluster import ClusterDecision
from fcslam.graph.evidence import AGREES_M, AGREES_RAD, ClusterEvidence
from fcslam.lidar.scan import PointScan
from fcslam.lidar.submap import build_submap
from fcslam.lidar.verification import verify
from fcslam.places.matcher import PlaceMatch
from fcslam.records import (
    Change,
    ClosureStatus,
    Constraint,
    Cut,
    FloatArray,
    KeyscanId,
    ManualClosure,
    Pin,
    Reason,
    ReasonCode,
    Tag,
    Veto,
)
from fcslam.storage.snapshot import Kept

CONTESTED_GROWTH = 1.1
"""After a re-evaluation confirmed a contested join, the number of closures grows by this factor before the next one:
the same evidence would be weighed again at every place."""

PLACES_A_SESSION = 0.5
"""Robots join after so many places for each session: a re-evaluation takes about as long as a place for each."""
REFINED_KEYSCANS = 15
"""Scans before and after each end of a closure by hand whose walls refine it: a few metres of path."""
DECIDED_GROWTH = 1.0 + SOLVED_SHARE
"""Sessions whose evidence fell short are decided again when it has grown by this factor, or in a re-evaluation. A
decision tests every pair of closures: at each place, it would take longer than all else where robots meet for hours."""

Scans = Sequence[tuple[PointScan, FloatArray]]
"""Scans around a keyscan, and their poses (3,) in its base."""


class ClosureDecisions(Kept):
    """Accepts closures, joins maps, applies edits and re-evaluates all of it when evidence turns.

    Its state is without the closures, the comparisons of maps and the changes by hand.
    """

    KEPT: ClassVar = {
        "_due": dict[frozenset[str], int],
        "maps": list[list[str]],
        "joins": dict[frozenset[str], ClusterEvidence],
        "version": int,
        "_joins": bool,
        "_contested": bool,
        "_evaluated": int,
        "_waited": int,
    }

    def __init__(self, config: FleetConfig, sessions: SessionStore, graph: JointGraph, space: Space) -> None:
        self._config = config
        self._sessions = sessions
        self._space = space
        self._graph = graph
        self.comparison = MapComparison(sessions, space)
        self._due: dict[frozenset[str], int] = {}
        """Number of closures between two sessions from which on they are decided again."""
        self.closures = ClosureLog()
        self.maps: list[list[str]] = []
        """Sessions by map; maps, and the sessions in them, in the order in which they started."""
        self.joins: dict[frozenset[str], ClusterEvidence] = {}
        """On what evidence two sessions share a map."""
        self.separated: list[tuple[list[str], list[str]]] = []
        """Groups of sessions that shared a map until a re-evaluation, and whose places are to be compared again."""
        self.version = 0
        """How often the joint graph was solved."""
        self.changes: tuple[Change, ...] = ()
        """The changes by hand that are in force."""
        self._joins = False
        """Whether evidence is enough for a join."""
        self._contested = False
        """Whether evidence has turned against a join."""
        self._evaluated = 0
        """Number of closures at the last re-evaluation."""
        self._waited = 0
        """How many places and sightings of tags came in since then."""

    def map_of(self, session: str) -> list[str]:
        """The sessions that share a map with this one, itself included."""
        return next(sessions for sessions in self.maps if session in sessions)

    def add_local(self, closure: Constraint, tag: Tag | None = None) -> None:
        """Accept a closure within a robot's own map, which it found or a ``tag`` gives, unless it is vetoed."""
        i, j = KeyscanId(closure.robot, closure.i), KeyscanId(closure.robot, closure.j)
        edge = self._graph.close(i, j, closure.T_i_j, closure.information)
        entry = self.closures.add_local(closure, edge, tag)
        self._mark(entry)
        if entry.vetoed:
            self._graph.count(edge, holds=False)

    def add_matches(self, matches: Iterable[PlaceMatch], session: str) -> None:
        """Accept the matches of a session's new place that fit the joint map; join maps on a dominant cluster."""
        entries = [self.closures.add(match) for match in matches if not self.closures.confirms(match)]
        for entry in entries:
            self._mark(entry)
        usable = [entry for entry in entries if entry.is_measured and not entry.vetoed]
        undecided = [entry for entry in usable if not self._accept_if_consistent(entry)]
        for other in dict.fromkeys(entry.closure.i.robot for entry in undecided):
            between = [entry for entry in undecided if entry.closure.i.robot == other]
            # A pair decided just before may have joined these two as well.
            if [entry for entry in between if not self._accept_if_consistent(entry)]:
                self._decide_pair(other, session)

    def optimize_if_due(self) -> None:
        """Solve the joint graph if enough closures are new; re-evaluate if evidence speaks for or against a join.

        Called for each place. A re-evaluation takes as long as there are sessions, so it waits for as many closures and
        for half as many places: robots that meet at the same time join together.
        """
        self._waited += 1
        # The graph of a robot alone is solved once, at the end.
        if len(self._sessions.robots) > 1 and self._graph.is_due(self._config.solve_every):
            self._graph.optimize()
            self._contested |= self._are_maps_refuted()
            self.version += 1
        is_contested = self._contested and len(self.closures) >= int(CONTESTED_GROWTH * self._evaluated)
        sessions, new = len(self._sessions.robots), len(self.closures) - self._evaluated
        if is_contested or (self._joins and new >= sessions and self._waited >= PLACES_A_SESSION * sessions):
            self.reevaluate()

    def edit(self, changes: Sequence[Change]) -> bool:
        """Replace the changes by hand that are in force: they exclude and pin closures, and no others do.

        Returns whether a decision changed.
        """
        self.changes = tuple(changes)
        turned = [entry for entry in self.closures if self._mark(entry)]
        decided = any(entry.pinned or entry.closure.status is not ClosureStatus.CANDIDATE for entry in turned)
        if decided or self._missing(final=False):
            self.reevaluate()
            return True
        return False

    def reevaluate(self, *, final: bool = False) -> Fusion:
        """Decide every closure again from all evidence: revoke outvoted ones, separate maps that only they joined.

        ``final``: no packet comes after it, so closures by hand may end at the last keyscan of a session.
        """
        for made in self._missing(final):
            i, j = self._ends(made)
            by_walls = measured(made, self._scans(i), self._scans(j))
            self._mark(self.closures.add_by_hand(made, i, j, *self._space.measured(i, j, *by_walls)))
        fusion = reevaluate(
            self._graph,
            self.closures,
            self._config.consistency,
            partial(self.comparison.fit, growth=1.0) if final else self.comparison.fit,
            self.comparison.at,
        )
        if final:
            joins = {pair: self._compared(pair, evidence, fusion) for pair, evidence in fusion.joins.items()}
            fusion = replace(fusion, joins=joins)
        self.separated += _separated(self.maps, fusion.maps)
        self.maps, self.joins = [list(sessions) for sessions in fusion.maps], dict(fusion.joins)
        self._due.clear()
        self._joins, self._contested, self._evaluated, self._waited = False, False, len(self.closures), 0
        self.version += 1
        return fusion

    def _compared(self, pair: frozenset[str], evidence: ClusterEvidence, fusion: Fusion) -> ClusterEvidence:
        """The evidence of a join with the fit of both maps, which was not needed if other joins decided."""
        if evidence.fit is not None and evidence.fit.seen_m:
            return evidence
        a, b = sorted(pair, key=self._sessions.robots.index)
        return replace(evidence, fit=self.comparison.of_join((a, b), fusion, evidence.fit))

    def _mark(self, entry: ClosureEntry) -> bool:
        """Note whether users exclude or pin the closure; returns whether that is new."""
        before = entry.vetoed, entry.pinned
        i, j = ((end.robot, self._sessions.stamp(end)) for end in (entry.closure.i, entry.closure.j))
        is_undone = entry.made_by_hand is not None and entry.made_by_hand not in self.changes
        entry.vetoed = (
            is_undone
            or any(is_removed(session, self.changes) for session, _ in (i, j))
            or any(change.forbids(*i, *j) for change in self.changes if isinstance(change, Veto))
            or self._is_cut(entry)
        )
        pins = [change for change in self.changes if isinstance(change, Pin)]
        entry.pinned = entry.made_by_hand is not None or any(pin.confirms(*i, *j) for pin in pins)
        return before != (entry.vetoed, entry.pinned)

    def _is_cut(self, entry: ClosureEntry) -> bool:
        """Whether users cut a scan behind the closure: of the submaps that were compared, or else of its two ends."""
        cuts = [change for change in self.changes if isinstance(change, Cut)]
        if not cuts:
            return False
        is_of_places = entry.is_between and entry.made_by_hand is None
        for end in (entry.closure.i, entry.closure.j):
            span = self._sessions.span(end, entry.closure.channel) if is_of_places else (end.number, end.number)
            stamps = (self._sessions.stamp(KeyscanId(end.robot, k)) for k in range(span[0], span[1] + 1))
            if any(is_cut(end.robot, stamp, cuts) for stamp in stamps):
                return True
        return False

    def _missing(self, final: bool) -> list[ManualClosure]:
        """Closures by hand, in force, that are not in the log yet and whose keyscans are there.

        Unless this is ``final``, a later keyscan may be nearer than the newest one of a session.
        """
        made = [change for change in self.changes if isinstance(change, ManualClosure)]
        entered = {entry.made_by_hand for entry in self.closures} if made else set()
        present = set(self._sessions.robots)
        return [
            change
            for change in made
            if change not in entered
            and {change.robot_i, change.robot_j} <= present
            and not any(is_removed(session, self.changes) for session in (change.robot_i, change.robot_j))
            and self._sessions.floor(change.robot_i) == self._sessions.floor(change.robot_j)
            and len(set(self._ends(change))) == 2
            and (final or all(self._sessions.stamps(session)[-1] >= stamp for session, stamp in stamps_of(change)))
        ]

    def _ends(self, made: ManualClosure) -> tuple[KeyscanId, KeyscanId]:
        return self._sessions.nearest(made.robot_i, made.stamp_i), self._sessions.nearest(made.robot_j, made.stamp_j)

    def _scans(self, end: KeyscanId) -> Scans:
        first, last = max(end.number - REFINED_KEYSCANS, 0), end.number + REFINED_KEYSCANS
        return self._space.scans(end, first, self._graph.chain(end.robot, first, last))

    def _accept_if_consistent(self, entry: ClosureEntry) -> bool:
        """Accept a verified closure that fits the joint map; False if only a cluster may accept it."""
        closure = entry.closure
        if closure.status is not ClosureStatus.VERIFIED:
            return True
        if closure.i.robot in self.map_of(closure.j.robot):
            off_m, off_rad = self._graph.innovation(closure.i, closure.j, closure.T_i_j)
            if off_m < AGREES_M and off_rad < AGREES_RAD:
                fits = Reason(ReasonCode.FITS_JOINT_MAP, off_m, AGREES_M)
                self._accept(entry, fits)
                return True
        entry.independent = True  # the joint map did not predict this closure
        return False

    def _decide_pair(self, a: str, b: str) -> None:
        entries, pair = self.closures.evidence(a, b), frozenset((a, b))
        if self._joins or len(entries) < self._due.get(pair, 0):
            return  # the re-evaluation to come decides every pair
        robots = (a, b) if self._sessions.robots.index(a) < self._sessions.robots.index(b) else (b, a)
        decision = decide_join(entries, robots, self._graph, self._config.consistency, self.comparison.fit)
        if b in self.map_of(a):
            self._contested |= self._is_contested(decision, entries)
        if decision.shortfall is not None:
            for entry in entries:
                if entry.closure.status is ClosureStatus.VERIFIED:
                    entry.set(ClosureStatus.VERIFIED, decision.shortfall.under(CONSISTENCY))
        else:
            self._joins |= any(entries[k].closure.status is not ClosureStatus.ACCEPTED for k in decision.members)
        self._due[pair] = int(DECIDED_GROWTH * len(entries)) + 1

    def _accept(self, entry: ClosureEntry, reason: Reason) -> None:
        closure = entry.closure
        if entry.edge is None:
            entry.edge = self._graph.close(closure.i, closure.j, closure.T_i_j, closure.information)
        self._graph.count(entry.edge, holds=True)
        entry.set(ClosureStatus.ACCEPTED, reason)

    def _are_maps_refuted(self) -> bool:
        """Whether the maps of two joined sessions contradict each other by now: of those that have grown most.

        One pair after each solve: all of them would delay the packets that wait.
        """
        growth = {
            pair: self.comparison.growth(pair, sum(len(self._graph.trajectory(session)) for session in pair))
            for pair in self.joins
        }
        pair = max(growth, key=growth.__getitem__, default=frozenset[str]())
        if growth.get(pair, 0.0) < GROWTH * GROWTH:
            return False
        a, b = sorted(pair, key=self._sessions.robots.index)
        return not self.comparison.agree_still((a, b), self._graph.trajectory(a), self._graph.trajectory(b))

    def _is_contested(self, decision: ClusterDecision, entries: Sequence[ClosureEntry]) -> bool:
        """Whether a decision speaks against a join: it has no dominant cluster, or most of that lies elsewhere."""
        if not decision.contested or decision.shortfall is not None:
            return decision.contested
        members = [entries[k].closure for k in decision.members]
        off_m = [self._graph.innovation(closure.i, closure.j, closure.T_i_j)[0] for closure in members]
        return 2 * sum(off > AGREES_M for off in off_m) > len(off_m)


def _separated(before: Sequence[Sequence[str]], after: Sequence[Sequence[str]]) -> list[tuple[list[str], list[str]]]:
    pairs = []
    for sessions in before:
        parts = [part for map_ in after if (part := [session for session in map_ if session in sessions])]
        pairs += list(combinations(parts, 2))
    return pairs


def measured(made: ManualClosure, i: Scans, j: Scans) -> tuple[FloatArray, FloatArray]:
    """Pose of j in i (3,) and its information (3, 3), as the walls around both ends refine them.

    They are as the user gave them if the ends see too little in common, or fit only outside the user's tolerance.
    """
    metres, radians = made.tolerance
    guess, information = np.array(made.T_i_j), np.diag([1.0 / metres**2, 1.0 / metres**2, 1.0 / radians**2])
    if not all(any(len(scan.points) for scan, _ in scans) for scans in (i, j)):
        return guess, information
    found = verify(build_submap(i), build_submap(j), guess, information)
    off = np.abs(se2.between(guess, found.T_a_b))
    fits = found.loose and np.hypot(off[0], off[1]) <= AGREES_SIGMAS * metres and off[2] <= AGREES_SIGMAS * radians
    return (found.T_a_b, found.information) if fits else (guess, information)
