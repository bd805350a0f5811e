"""Several robots in one graph: which robots share a map, which closures are inliers, and all poses.

Most closures between robots may be false, and false ones may be consistent with one another. The transforms between the
robots' frames are unknown. Pairwise consistency finds these; graduated non-convexity then decides every closure.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from fcslam.geometry.groups import SE2, group_of
from fcslam.graph.bridges import contradicted_bridges
from fcslam.graph.cluster import (
    ClusterDecision,
    MayDecide,
    closure_positions,
    decide_cluster,
    evidence_of,
    relative_frame,
)
from fcslam.graph.consistency import Closures, count_supporting_closures
from fcslam.graph.evidence import DISTINCT_M, DISTINCT_RAD, ConsistencySettings, MapFit, shortfall
from fcslam.graph.initialization import initialize
from fcslam.graph.optimizer import INLIER_WEIGHT, Solution, optimize_gnc, refine_inliers
from fcslam.graph.pose_graph import PoseGraph
from fcslam.graph.single_robot import robot_trajectory, solve_single_robot
from fcslam.graph.trajectory import Trajectory
from fcslam.records import FloatArray, Reason, ReasonCode, frozen

ExaminePair = Callable[[int, int, Trajectory, Trajectory, Closures, MayDecide], MapFit | None]
"""As ``Examine``: it takes the numbers of the robots, their own trajectories, and the closures."""

CompareJointMaps = Callable[[int, int, FloatArray, FloatArray], MapFit]
"""Compares the maps of two robots at joint poses: takes their numbers and the poses of their variables, (N, P) each."""

_Relation = tuple[int, int, FloatArray]
"""Two robots a and b, and the transform T_a_b between their own frames, shape (P,)."""


@dataclass(frozen=True, slots=True, eq=False)
class JointEvidence:
    """All measurements of several robots: odometry, closures within each robot, closures between robots."""

    graph: PoseGraph
    """An edge between two robots that is not robust is known to be true: it joins their maps."""
    robots: tuple[NDArray[np.int64], ...]
    """Variables of each robot in the order of its path; every variable belongs to one robot."""
    informative: NDArray[np.bool_]
    """Per edge, shape (E,): whether it fixes the pose in every direction."""
    independent: NDArray[np.bool_]
    """Per edge, shape (E,): whether it was found without an estimate of the transform between the two robots' frames.
    Only such closures are evidence for this transform."""
    excluded: NDArray[np.bool_]
    """Per edge, shape (E,): closures that are known to be false, as by a veto."""
    tags: NDArray[np.int64] | None = None
    """Per edge, shape (E,): number from 1 of the tag that both keyscans saw, 0 without one. None: no edge has one."""
    senders: tuple[int, ...] | None = None
    """Sender of each robot's packets: its sessions count as one in the search for false bridges. None: each its own."""


@dataclass(frozen=True, slots=True, eq=False)
class Link:
    """The independent closures between two robots, and the decision on them."""

    a: int
    b: int
    edges: NDArray[np.int64]
    """Independent closures between the robots, as edges of the graph, shape (K,)."""
    decision: ClusterDecision
    """Its members are indices into ``edges``."""
    closures: Closures
    """The same K closures, from a to b."""
    T_a_b: FloatArray
    """Transform between the robots' own frames by the largest cluster, shape (P,)."""

    @property
    def members(self) -> NDArray[np.int64]:
        """Edges of the largest cluster."""
        return self.edges[list(self.decision.members)]


@dataclass(frozen=True, slots=True, eq=False)
class JointSolution:
    """Poses of all robots and the weight of every closure."""

    poses: FloatArray
    """Shape (N, P), each in the frame of its map; the first pose of its first robot stays where the graph has it."""
    weights: FloatArray
    """Shape (E,): 1 for inliers and odometry, 0 for outliers."""
    maps: tuple[int, ...]
    """Number of each robot's map, counted in the order of their first robots."""
    links: tuple[Link, ...]
    """One for every two robots with independent closures between them."""
    joining: tuple[Link, ...]
    """Those with a dominant cluster. Where other links predict it, the maps of these robots were not compared."""
    own: tuple[FloatArray, ...]
    """Poses of each robot from its own measurements alone, shape (N_k, P); the first stays where the graph has it."""
    apart: Mapping[tuple[int, int], Reason]
    """Pairs of robots a < b that closures would join, and that stay apart because maps contradict each other."""


def solve_jointly(
    evidence: JointEvidence,
    consistency: ConsistencySettings,
    examine: ExaminePair = lambda *_: None,
    compare: CompareJointMaps = lambda *_: MapFit(),
) -> JointSolution:
    """Find poses, maps and inlier closures from the evidence alone; no earlier estimate plays a part.

    A link is dropped, and the rest solved again, if

    - a third of its cluster turns out as outliers in the joint solution;
    - the remaining members would not be enough to join two maps;
    - it joins maps that contradict each other.

    Args:
        evidence: graph of N variables and E edges, with the role of every edge.
        consistency: when closures are consistent, and what a cluster needs.
        examine: compares the maps of two robots at the transform of a cluster with enough closures.
        compare: called for robots of one map that only one other sender connects.

    Returns:
        Poses (N, P), weights (E,), and the maps.
    """
    # 1. Optimize each robot's own graph.
    initial = evidence.graph.poses()
    own = [_solve_own_graph(evidence, robot, initial[robot]) for robot in evidence.robots]
    paths = [path for path, _ in own]
    # 2. Find the largest cluster of closures between every two robots (PCM).
    independent = _pairs(evidence, evidence.independent & ~evidence.excluded)
    pairs = {(a, b): (rows, closures) for a, b, rows, closures in independent}

    def link(a: int, b: int, examine: ExaminePair = lambda *_: None) -> Link:
        return _find_link(evidence, (a, b), (paths[a], paths[b]), *pairs[a, b], consistency, examine)

    links, compared = {pair: link(*pair) for pair in pairs}, dict[tuple[int, int], Link]()

    def compare_maps(found: Link) -> Link:
        pair = found.a, found.b
        if len(found.members) >= consistency.minimum_closures and pair not in compared:
            compared[pair] = link(*pair, examine)
        return compared.get(pair, found)

    known = _known_transforms(evidence, paths)
    _, bound, _ = _merge_frames(paths, known, (), compare_maps)
    apart: dict[tuple[int, int], Reason] = {}
    left = links
    senders = evidence.senders or range(len(own))
    while True:
        # 3. Merge the robots' frames along the strongest links, if the maps agree.
        frames, maps, joining = _merge_frames(paths, known, left.values(), compare_maps)
        within_maps = _edges_within_maps(evidence, maps)
        # 4. Solve with the supported closures, then decide all closures within maps by that solution.
        supported = within_maps & _supported_edges(evidence, [inliers for _, inliers in own], joining)
        solution = _solve_supported(evidence, supported, paths, frames, bool(known or joining))
        solution = _refine_inliers(evidence.graph, within_maps, solution)
        # 5. Withdraw isolated closures and decide once more.
        isolated = _isolated_closures(evidence, paths, solution, consistency.separation_m)
        if isolated.any():
            trusted = replace(solution, weights=solution.weights * ~isolated)
            solution = _refine_inliers(evidence.graph, within_maps, trusted)
        # 6. Repeat without the links that the joint solution contradicts.
        false = {
            (link.a, link.b)
            for link in joining
            if not is_confirmed(link, paths, solution, evidence.informative, consistency)
        }
        # 7. Robots that alone join maps that contradict each other leave them.
        if not false:
            bridges = _false_bridges(evidence, solution, senders, compare)
            apart |= {(a, b): reason for (a, b), reason in bridges.items() if bound[a] != bound[b]}
            false = {(link.a, link.b) for link in joining} & apart.keys()
        if not false:
            own_poses: tuple[FloatArray, ...] = tuple(frozen(path.poses) for path in paths)
            found = tuple((links | compared).values())
            return JointSolution(solution.poses, solution.weights, tuple(maps), found, tuple(joining), own_poses, apart)
        left = {pair: link for pair, link in left.items() if pair not in false}


def _solve_own_graph(
    evidence: JointEvidence, robot: NDArray[np.int64], initial: FloatArray
) -> tuple[Trajectory, NDArray[np.int64]]:
    graph = evidence.graph
    number = np.full(len(graph), -1)
    number[robot] = np.arange(len(robot))
    edges = graph.arrays()
    mine = np.flatnonzero((number[edges.i] >= 0) & (number[edges.j] >= 0) & ~evidence.excluded)
    own = graph.given().select(mine)
    own_graph = PoseGraph.restored(initial, replace(own, i=number[own.i], j=number[own.j]))
    solution = solve_single_robot(own_graph)
    return robot_trajectory(own_graph, solution.poses), mine[solution.weights > INLIER_WEIGHT]


def _find_link(
    evidence: JointEvidence,
    robots: tuple[int, int],
    own: tuple[Trajectory, Trajectory],
    edges: NDArray[np.int64],
    closures: Closures,
    settings: ConsistencySettings,
    examine: ExaminePair,
) -> Link:
    def examine_members(members: NDArray[np.int64], may_decide: MayDecide) -> MapFit | None:
        return examine(*robots, *own, closures.select(members), may_decide)

    decision = decide_cluster(*own, closures, evidence.informative[edges], settings, examine_members)
    members = closures.select(np.array(decision.members, dtype=np.int64))
    return Link(*robots, edges, decision, closures, relative_frame(*own, members))


def _pairs(
    evidence: JointEvidence, chosen: NDArray[np.bool_]
) -> Iterator[tuple[int, int, NDArray[np.int64], Closures]]:
    """Every two robots with chosen closures between them: a, b, the edges (K,), and the closures from a to b."""
    edges, (owner, index) = evidence.graph.arrays(), _owners(evidence)
    between = np.flatnonzero(edges.robust & chosen & (owner[edges.i] != owner[edges.j]))
    ends = np.sort(np.stack((owner[edges.i[between]], owner[edges.j[between]])), axis=0)
    for a, b in np.unique(ends, axis=1).T.tolist():
        rows = between[(ends[0] == a) & (ends[1] == b)]
        ends_of = index[edges.i[rows]], index[edges.j[rows]]
        tags = np.empty(0, np.int64) if evidence.tags is None else evidence.tags[rows]
        closures = Closures(*ends_of, edges.T_i_j[rows], edges.information[rows], tags)
        yield a, b, rows, closures.reversed(owner[edges.i[rows]] == b)


def _known_transforms(evidence: JointEvidence, own: Sequence[Trajectory]) -> list[_Relation]:
    """Transforms between the robots' own frames by the edges between robots that are known to be true."""
    edges, (owner, index) = evidence.graph.arrays(), _owners(evidence)
    between = np.flatnonzero(~edges.robust & (owner[edges.i] != owner[edges.j]))
    relations, group = list[_Relation](), evidence.graph.group
    for i, j, T_i_j in zip(edges.i[between], edges.j[between], edges.T_i_j[between], strict=True):
        a, b = int(owner[i]), int(owner[j])
        T_a_i, T_b_j = own[a].poses[index[i]], own[b].poses[index[j]]
        relations.append((a, b, group.compose(group.compose(T_a_i, T_i_j), group.inverse(T_b_j))))
    return relations


def _merge_frames(
    own: Sequence[Trajectory], known: Sequence[_Relation], links: Iterable[Link], compare_maps: Callable[[Link], Link]
) -> tuple[list[FloatArray], list[int], list[Link]]:
    """``T_map_own`` of every robot, the number of its map, and the links that join: a spanning tree that takes what is
    known first, then the strongest links.

    To compare maps takes longest. Of robots in one map already, only those are compared whose link lies elsewhere.
    """
    group = group_of(own[0].poses) if own else SE2
    frames, maps = [group.identity.copy() for _ in own], list(range(len(own)))
    joining: list[Link] = []

    def is_predicted(link: Link) -> bool:
        members = link.closures.select(np.array(link.decision.members, dtype=np.int64))
        T_map_i = group.compose(frames[link.a], own[link.a].poses[members.i])
        T_map_j = group.compose(frames[link.b], own[link.b].poses[members.j])
        off = group.between(group.between(T_map_i, T_map_j), members.T_i_j)
        return bool(np.median(group.shift_m(off)) <= DISTINCT_M and np.median(group.turn_rad(off)) <= DISTINCT_RAD)

    for relation in known:
        merge(frames, maps, *relation)
    for link in sorted(links, key=lambda link: (-link.decision.evidence.separate_places, -len(link.members))):
        found = link if maps[link.a] == maps[link.b] and is_predicted(link) else compare_maps(link)
        if found.decision.dominant:
            joining.append(found)
            merge(frames, maps, found.a, found.b, found.T_a_b)
    order = {first: number for number, first in enumerate(dict.fromkeys(maps))}
    return frames, [order[first] for first in maps], joining


def merge(frames: list[FloatArray], maps: list[int], a: int, b: int, T_a_b: FloatArray) -> bool:
    """Put the younger map of two robots into the frame of the older one, if they are two; returns whether they were.

    ``frames`` (``T_map_own``) and ``maps`` (the number of the first robot) of each robot are changed.
    """
    older, younger = sorted((maps[a], maps[b]))
    if older == younger:
        return False
    group = group_of(T_a_b)
    T = group.compose(group.compose(frames[a], T_a_b), group.inverse(frames[b]))  # between the maps of a and b
    T = T if maps[a] == older else group.inverse(T)
    for robot in (robot for robot, number in enumerate(maps) if number == younger):
        frames[robot], maps[robot] = group.compose(T, frames[robot]), older
    return True


def _edges_within_maps(evidence: JointEvidence, maps: Sequence[int]) -> NDArray[np.bool_]:
    """Edges that may count, shape (E,): all but excluded closures and closures between different maps."""
    edges, (owner, _) = evidence.graph.arrays(), _owners(evidence)
    map_of = np.array(maps)[owner]
    within: NDArray[np.bool_] = map_of[edges.i] == map_of[edges.j]
    return ~edges.robust | (within & ~evidence.excluded)


def _supported_edges(
    evidence: JointEvidence, own: Sequence[NDArray[np.int64]], links: Sequence[Link]
) -> NDArray[np.bool_]:
    """Odometry, inliers of a robot's own graph, and members of a link's cluster, shape (E,)."""
    supported = ~evidence.graph.arrays().robust
    for inliers in own:
        supported[inliers] = True
    for link in links:
        supported[link.members] = True
    return supported


def _solve_supported(
    evidence: JointEvidence,
    supported: NDArray[np.bool_],
    own: Sequence[Trajectory],
    frames: Sequence[FloatArray],
    joined: bool,
) -> Solution:
    """Graduated non-convexity with supported closures only, so that false ones cannot distort its start.

    It starts from the robots' own solutions. If robots are ``joined`` and not every closure holds, it starts from the
    chordal initialization as well, which does not depend on drift; the cheaper result counts. A robot's own solution is
    already the best of several starts. Other closures have weight 0.
    """
    graph = evidence.graph
    start = graph.poses()
    for robot, path, frame in zip(evidence.robots, own, frames, strict=True):
        start[robot] = graph.group.compose(frame, path.poses)
    subgraph = graph.restricted(start, supported)
    solution = optimize_gnc(subgraph, start)
    if joined and not solution.weights.all():
        other = optimize_gnc(subgraph, initialize(subgraph))
        solution = min(solution, other, key=lambda solution: solution.cost)
    return _expand_weights(solution, supported)


def _refine_inliers(graph: PoseGraph, within_maps: NDArray[np.bool_], trusted: Solution) -> Solution:
    """Decide every edge within a map, starting from the inliers of a trusted solution."""
    subgraph = graph.restricted(trusted.poses, within_maps)
    refined = refine_inliers(subgraph, None, trusted.weights[within_maps])
    return _expand_weights(refined, within_maps)


def _isolated_closures(
    evidence: JointEvidence, own: Sequence[Trajectory], solution: Solution, separation_m: float
) -> NDArray[np.bool_]:
    """Inlier closures that no other closure supports and that alone constrain a stretch of the path, shape (E,).

    Only closures between robots most of whose closures are outliers: of many false closures, one may be consistent by
    chance where the path is loose enough to follow it. There, one counts only if the rest of the graph predicts it.
    """
    inliers = solution.weights > INLIER_WEIGHT
    loose = _distance_to_next_closure_m(evidence, own, inliers) >= separation_m
    isolated = np.zeros(len(inliers), dtype=bool)
    for a, b, rows, closures in _pairs(evidence, ~evidence.excluded):
        kept = np.flatnonzero(inliers[rows])
        if 2 * len(kept) < len(rows):
            unsupported = count_supporting_closures(own[a], own[b], closures.select(kept)) == 0
            isolated[rows[kept]] = unsupported & loose[rows[kept]]
    return isolated


def _distance_to_next_closure_m(
    evidence: JointEvidence, own: Sequence[Trajectory], inliers: NDArray[np.bool_]
) -> FloatArray:
    """Path length from the worse end of each inlier closure to the nearest end of another one, (E,); other edges: 0."""
    edges, (owner, index) = evidence.graph.arrays(), _owners(evidence)
    closures = np.flatnonzero(edges.robust & inliers)
    ends = np.concatenate((edges.i[closures], edges.j[closures]))
    gap = np.full(len(ends), np.inf)
    for robot, path in enumerate(own):
        mine = np.flatnonzero(owner[ends] == robot)
        mine = mine[np.argsort(path.travel_m[index[ends[mine]]], kind="stable")]
        between = np.diff(path.travel_m[index[ends[mine]]])
        gap[mine] = np.minimum(np.append(between, np.inf), np.append(np.inf, between))
    distance = np.zeros(len(edges.i))
    distance[closures] = gap.reshape(2, -1).max(axis=0)
    return distance


def is_confirmed(
    link: Link,
    own: Sequence[Trajectory],
    solution: Solution,
    informative: NDArray[np.bool_],
    settings: ConsistencySettings,
) -> bool:
    """Whether over two thirds of the link's cluster are inliers, and these are enough to join two maps."""
    kept = np.flatnonzero(solution.weights[link.members] > INLIER_WEIGHT)
    members = np.array(link.decision.members, dtype=np.int64)[kept]
    closures = link.closures.select(members)
    positions = closure_positions(own[link.a], own[link.b], closures)
    found = evidence_of(positions, informative[link.edges[members]], closures.shared_tags(), settings.separation_m)
    remaining = replace(found, fit=link.decision.evidence.fit)
    return 3 * len(members) > 2 * len(link.members) and shortfall(remaining, settings) is None


def _false_bridges(
    evidence: JointEvidence, solution: Solution, senders: Sequence[int], compare: CompareJointMaps
) -> dict[tuple[int, int], Reason]:
    """Pairs of robots that must not share a map, because they alone join maps that contradict each other."""
    edges, (owner, _) = evidence.graph.arrays(), _owners(evidence)
    counting = (solution.weights > INLIER_WEIGHT) & (owner[edges.i] != owner[edges.j])
    ends = np.sort(np.stack((owner[edges.i[counting]], owner[edges.j[counting]])), axis=0)
    ties = [(int(a), int(b)) for a, b in np.unique(ends, axis=1).T]

    def compare_pair(a: int, b: int) -> MapFit:
        return compare(a, b, solution.poses[evidence.robots[a]], solution.poses[evidence.robots[b]])

    found = contradicted_bridges(ties, senders, compare_pair)
    return {pair: Reason(ReasonCode.FALSE_BRIDGE, contradicting) for pair, contradicting in found.items()}


def _owners(evidence: JointEvidence) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Robot of each variable and its index along the robot's path, shape (N,) each."""
    owner, index = np.full((2, len(evidence.graph)), -1)
    for number, variables in enumerate(evidence.robots):
        owner[variables], index[variables] = number, np.arange(len(variables))
    return owner, index


def _expand_weights(solution: Solution, kept: NDArray[np.bool_]) -> Solution:
    weights = np.zeros(len(kept))
    weights[kept] = solution.weights
    return replace(solution, weights=frozen(weights))
