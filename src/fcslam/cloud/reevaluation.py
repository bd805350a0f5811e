"""Re-evaluation: decide every closure from all evidence, independent of earlier decisions."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace

import numpy as np

from fcslam.cloud.closure_log import ClosureEntry, ClosureLog
from fcslam.cloud.joining import CONSISTENCY, ExamineSessions
from fcslam.cloud.joint_graph import JointGraph
from fcslam.cloud.result import Fusion
from fcslam.cloud.sessions import robot_of
from fcslam.graph.consistency import Closures
from fcslam.graph.evidence import ConsistencySettings, MapFit
from fcslam.graph.joint import JointEvidence, JointSolution, solve_jointly
from fcslam.graph.optimizer import INLIER_WEIGHT
from fcslam.graph.pose_graph import PoseGraph
from fcslam.graph.trajectory import Trajectory
from fcslam.records import ClosureStatus, FloatArray, Reason, ReasonCode, frozen

CompareSessions = Callable[[tuple[str, str], FloatArray, FloatArray], MapFit]
"""As ``MapComparison.at``."""

CONTRADICTS = Reason(ReasonCode.CONTRADICTS_JOINT_GRAPH)


def reevaluate(
    graph: JointGraph,
    closures: ClosureLog,
    settings: ConsistencySettings,
    examine: ExamineSessions,
    compare: CompareSessions,
) -> Fusion:
    """Solve the joint graph from all evidence; update the poses of the graph and the status of every entry.

    No earlier estimate, join or decision plays a part: a closure that joined two maps and is outvoted now is revoked.
    """
    measured = (entry for entry in closures if entry.is_measured)
    entries = [e for e in measured if e.is_certain or e.closure.status is not ClosureStatus.CANDIDATE]
    _enter(graph, (entry for entry in entries if entry.edge is None))
    robots = list(graph.robots())

    def examine_pair(a: int, b: int, path_a: Trajectory, path_b: Trajectory, members: Closures) -> MapFit | None:
        return examine((robots[a], robots[b]), path_a, path_b, members)

    def compare_pair(a: int, b: int, poses_a: FloatArray, poses_b: FloatArray) -> MapFit:
        return compare((robots[a], robots[b]), poses_a, poses_b)

    with graph.stages.measure("solve"):
        solution = solve_jointly(
            _evidence(graph, entries),
            settings,
            examine=examine_pair,
            compare=compare_pair,
        )
    graph.take(solution.poses)
    reasons = _reasons(solution, robots)
    clusters = {edge: len(link.members) for link in solution.joining for edge in link.members.tolist()}
    maps = dict(zip(robots, solution.maps, strict=True))
    for entry in entries:
        assert entry.edge is not None
        pair = frozenset((entry.closure.i.robot, entry.closure.j.robot))
        divided = len({maps[robot] for robot in pair}) > 1
        refuted = reasons.get(pair, CONTRADICTS) if divided else CONTRADICTS
        fits = Reason(ReasonCode.FITS_JOINT_GRAPH)
        if entry.edge in clusters:
            fits = Reason(ReasonCode.IN_CLUSTER, clusters[entry.edge])
        _decide(entry, bool(solution.weights[entry.edge] > INLIER_WEIGHT), fits, refuted)
        graph.count(entry.edge, holds=entry.closure.status is ClosureStatus.ACCEPTED)
    members = [[robot for robot in robots if maps[robot] == number] for number in sorted(set(solution.maps))]
    T_map_base: dict[str, FloatArray] = {robot: frozen(graph.trajectory(robot)) for robot in robots}
    T_local_base = dict(zip(robots, solution.own, strict=True))
    joins = {frozenset((robots[link.a], robots[link.b])): link.decision.evidence for link in solution.joining}
    return Fusion(members, T_map_base, T_local_base, tuple(entry.closure for entry in closures), joins)


def _enter(graph: JointGraph, entries: Iterable[ClosureEntry]) -> None:
    """Add edges for closures that have none; they do not count yet."""
    for entry in entries:
        closure = entry.closure
        entry.edge = graph.close(closure.i, closure.j, closure.T_i_j, closure.information)
        graph.count(entry.edge, holds=False)


def _evidence(graph: JointGraph, entries: list[ClosureEntry]) -> JointEvidence:
    count = len(graph.graph.edges)
    informative, independent, vetoed = np.ones(count, bool), np.zeros(count, bool), np.zeros(count, bool)
    for entry in entries:
        informative[entry.edge] = entry.closure.informative
        independent[entry.edge] = entry.independent
        vetoed[entry.edge] = entry.vetoed
    tags = np.zeros(count, np.int64)
    numbers = {tag: number for number, tag in enumerate(dict.fromkeys([None, *(e.closure.tag for e in entries)]))}
    for entry in entries:
        tags[entry.edge] = numbers[entry.closure.tag]
    certain = [entry.edge for entry in entries if entry.is_certain and entry.edge is not None]
    evident = graph.graph if not certain else _with_certain(graph.graph, certain)
    sessions = graph.robots()
    senders = [robot_of(session) for session in sessions]
    sender_numbers = tuple(map(senders.index, senders))
    return JointEvidence(evident, tuple(sessions.values()), informative, independent, vetoed, tags, sender_numbers)


def _with_certain(graph: PoseGraph, certain: list[int]) -> PoseGraph:
    edges = graph.given()
    robust = edges.robust.copy()
    robust[certain] = False
    return PoseGraph.restored(graph.poses(), replace(edges, robust=robust))


def _decide(entry: ClosureEntry, holds: bool, fits: Reason, contradiction: Reason) -> None:
    accepted_before = entry.closure.status is ClosureStatus.ACCEPTED
    if entry.vetoed:
        entry.set(ClosureStatus.REVOKED, Reason(ReasonCode.VETOED))
    elif entry.pinned:
        code = ReasonCode.PINNED if entry.made_by_hand is None else ReasonCode.MADE_BY_HAND
        entry.set(ClosureStatus.ACCEPTED, Reason(code))
    elif holds:
        entry.set(ClosureStatus.ACCEPTED, entry.closure.reason if accepted_before else fits)
    elif accepted_before or entry.closure.status is ClosureStatus.REVOKED:
        entry.set(ClosureStatus.REVOKED, contradiction)
    else:
        entry.set(ClosureStatus.REJECTED, contradiction)


def _reasons(solution: JointSolution, robots: list[str]) -> dict[frozenset[str], Reason]:
    short = {
        frozenset((robots[link.a], robots[link.b])): link.decision.shortfall.under(CONSISTENCY)
        for link in solution.links
        if link.decision.shortfall is not None
    }
    return short | _named(solution.apart, robots)


def _named(pairs: Mapping[tuple[int, int], Reason], robots: list[str]) -> dict[frozenset[str], Reason]:
    return {frozenset((robots[a], robots[b])): reason for (a, b), reason in pairs.items()}
