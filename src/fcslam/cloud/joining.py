"""Which closures hold and which maps they join: the cloud's closures in the terms of ``graph``, which decides.

``decide_join`` takes the closures of two robots, ``reevaluate`` all closures, independent of earlier decisions.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from fcslam.cloud.closure_log import ClosureEntry, ClosureLog
from fcslam.cloud.joint_graph import JointGraph
from fcslam.cloud.result import Fusion
from fcslam.cloud.sessions import robot_of
from fcslam.geometry.groups import Group
from fcslam.graph.cluster import ClusterDecision, MayDecide, decide_cluster
from fcslam.graph.consistency import Closures
from fcslam.graph.evidence import ClusterEvidence, ConsistencySettings, MapFit
from fcslam.graph.joint import JointEvidence, solve_jointly
from fcslam.graph.optimizer import INLIER_WEIGHT
from fcslam.graph.pose_graph import PoseGraph
from fcslam.graph.trajectory import Trajectory
from fcslam.records import ClosureStatus, FloatArray, Reason, ReasonCode, frozen

ExamineSessions = Callable[[tuple[str, str], Trajectory, Trajectory, Closures, MayDecide], MapFit | None]
"""As ``MapComparison.fit``."""

CONSISTENCY = "fleet.consistency"
"""Section of the configuration that holds the rule for joining maps."""


def decide_join(
    entries: Sequence[ClosureEntry],
    robots: tuple[str, str],
    graph: JointGraph,
    settings: ConsistencySettings,
    examine: ExamineSessions,
) -> ClusterDecision:
    """The dominant cluster among the closures of two robots, by the current estimate of their trajectories."""
    a, b = (graph.path(robot) for robot in robots)
    informative, closures = [entry.closure.informative for entry in entries], _closures(entries, robots[0], graph.group)
    return decide_cluster(
        a, b, closures, informative, settings, lambda rows, may: examine(robots, a, b, closures.select(rows), may)
    )


def _closures(entries: Sequence[ClosureEntry], robot_a: str, group: Group) -> Closures:
    found = [entry.closure for entry in entries]
    closures = Closures(
        np.array([closure.i.number for closure in found], dtype=np.int64),
        np.array([closure.j.number for closure in found], dtype=np.int64),
        np.array([closure.T_i_j for closure in found]).reshape(-1, group.size),
        np.array([closure.information for closure in found]).reshape(-1, group.freedom, group.freedom),
        _tag_numbers(entries),
    )
    return closures.reversed(np.array([closure.i.robot != robot_a for closure in found], dtype=bool))


def _tag_numbers(entries: Sequence[ClosureEntry]) -> NDArray[np.int64]:
    tags = [entry.closure.tag for entry in entries]
    numbers = {tag: number for number, tag in enumerate(dict.fromkeys([None, *tags]))}
    return np.array([numbers[tag] for tag in tags], np.int64)


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
    for entry in entries:
        if entry.edge is None:
            i, j, T_i_j, information = entry.closure.i, entry.closure.j, entry.closure.T_i_j, entry.closure.information
            entry.edge = graph.close(i, j, T_i_j, information)
            graph.count(entry.edge, holds=False)
    robots = list(graph.robots())
    solution = solve_jointly(
        _evidence(graph, entries),
        settings,
        examine=lambda a, b, *paths_and_members: examine((robots[a], robots[b]), *paths_and_members),
        compare=lambda a, b, *poses: compare((robots[a], robots[b]), *poses),
    )
    graph.take(solution.poses)
    shortfalls = {(link.a, link.b): link.decision.shortfall for link in solution.links}
    apart = {pair: reason.under(CONSISTENCY) for pair, reason in shortfalls.items() if reason} | dict(solution.apart)
    reasons = {frozenset((robots[a], robots[b])): reason for (a, b), reason in apart.items()}
    clusters = {edge: len(link.members) for link in solution.joining for edge in link.members.tolist()}
    maps = dict(zip(robots, solution.maps, strict=True))
    for entry in entries:
        assert entry.edge is not None
        pair = frozenset((entry.closure.i.robot, entry.closure.j.robot))
        divided = len({maps[robot] for robot in pair}) > 1
        refuted = reasons.get(pair, CONTRADICTS) if divided else CONTRADICTS
        size = clusters.get(entry.edge)
        fits = Reason(ReasonCode.FITS_JOINT_GRAPH) if size is None else Reason(ReasonCode.IN_CLUSTER, size)
        _decide(entry, bool(solution.weights[entry.edge] > INLIER_WEIGHT), fits, refuted)
        graph.count(entry.edge, holds=entry.closure.status is ClosureStatus.ACCEPTED)
    members = [[robot for robot in robots if maps[robot] == number] for number in sorted(set(solution.maps))]
    T_map_base: dict[str, FloatArray] = {robot: frozen(graph.trajectory(robot)) for robot in robots}
    T_local_base = dict(zip(robots, solution.own, strict=True))
    joins = {frozenset((robots[link.a], robots[link.b])): link.decision.evidence for link in solution.joining}
    certain = [frozenset((e.closure.i.robot, e.closure.j.robot)) for e in entries if e.is_certain and e.is_between]
    for pair in dict.fromkeys(certain):
        held = [entry.closure for entry in entries if {entry.closure.i.robot, entry.closure.j.robot} == pair]
        count = sum(closure.status is ClosureStatus.ACCEPTED for closure in held)
        a, b = sorted(pair, key=robots.index)
        joins[pair] = ClusterEvidence(count, count, 1, fit=compare((a, b), T_map_base[a], T_map_base[b]))
    return Fusion(members, T_map_base, T_local_base, tuple(entry.closure for entry in closures), joins)


def _evidence(graph: JointGraph, entries: list[ClosureEntry]) -> JointEvidence:
    count, rows = graph.graph.edge_count, np.array([entry.edge for entry in entries], np.int64)
    informative, independent, vetoed = np.ones(count, bool), np.zeros(count, bool), np.zeros(count, bool)
    tags = np.zeros(count, np.int64)
    informative[rows] = [entry.closure.informative for entry in entries]
    independent[rows] = [entry.independent for entry in entries]
    vetoed[rows] = [entry.vetoed for entry in entries]
    tags[rows] = _tag_numbers(entries)
    evident = graph.graph
    certain = rows[[entry.is_certain for entry in entries]]
    if len(certain):  # they count like odometry
        edges = evident.given()
        robust = edges.robust.copy()
        robust[certain] = False
        evident = PoseGraph.restored(evident.poses(), replace(edges, robust=robust))
    sessions = graph.robots()
    senders = [robot_of(session) for session in sessions]
    sender_numbers = tuple(map(senders.index, senders))
    return JointEvidence(evident, tuple(sessions.values()), informative, independent, vetoed, tags, sender_numbers)


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
