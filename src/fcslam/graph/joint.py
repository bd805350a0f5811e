"""Several robots in one graph: who shares a map, which closures hold, where everybody is.

Most closures between robots may be false, and false ones may agree with one another. Nothing is known of how the
robots' frames lie to each other. Pairwise consistency says it, graduated non-convexity decides every closure.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from fcslam.geometry import se2
from fcslam.graph.alone import path_of, solve_alone
from fcslam.graph.cluster import ClusterVerdict, apart, judge, places_of, relative_frame
from fcslam.graph.consistency import Closures, ConsistencySettings, witnesses
from fcslam.graph.initialization import initialize
from fcslam.graph.optimizer import GncSettings, Solution, optimize_gnc, settle
from fcslam.graph.pose_graph import Edge, PoseGraph
from fcslam.graph.trajectory import Trajectory
from fcslam.records import FloatArray, frozen

HOLDS = 0.5
"""Graduated non-convexity ends at weight 1 (the closure holds) or 0."""


@dataclass(frozen=True, slots=True, eq=False)
class JointEvidence:
    """All that several robots measured: odometry, closures within each, closures between them."""

    graph: PoseGraph
    robots: tuple[NDArray[np.int64], ...]
    """Each robot's variables in the order of its path; every variable belongs to one robot."""
    informative: NDArray[np.bool_]
    """Per edge, shape (E,): whether it fixes the pose in every direction."""
    independent: NDArray[np.bool_]
    """Per edge, shape (E,): whether it was found without an estimate of how the two robots' frames lie. Only such
    closures are evidence that they lie so; the others follow."""
    excluded: NDArray[np.bool_]
    """Per edge, shape (E,): closures that somebody knows to be false."""


@dataclass(frozen=True, slots=True, eq=False)
class Link:
    """What the closures between two robots say together."""

    a: int
    b: int
    edges: NDArray[np.int64]
    """Independent closures between them."""
    verdict: ClusterVerdict
    """Its members count in ``edges``."""
    closures: Closures
    T_a_b: FloatArray | None
    """Of the two robots' own frames; None where no cluster dominates."""

    @property
    def members(self) -> NDArray[np.int64]:
        """Edges of the largest cluster."""
        return self.edges[list(self.verdict.members)]


@dataclass(frozen=True, slots=True, eq=False)
class JointSolution:
    """Everybody's poses and every closure's verdict."""

    poses: FloatArray
    """Shape (N, 3), each in the frame of its map: its first robot's first pose stays where the graph has it."""
    weights: FloatArray
    """Shape (E,): 1 holds, 0 does not."""
    maps: tuple[int, ...]
    """Number of each robot's map, counted in the order of their first robots."""
    links: tuple[Link, ...]
    """Of every two robots between whom there are independent closures."""
    own: tuple[FloatArray, ...]
    """Each robot's poses by its own measurements alone, (N_k, 3); its first stays where the graph has it."""


def solve_jointly(
    evidence: JointEvidence, consistency: ConsistencySettings, gnc: GncSettings | None = None
) -> JointSolution:
    """Poses, maps and closures that hold, from the evidence alone: no earlier estimate plays a part.

    A link whose cluster loses a third of its members in the joint solution, or so many places that it would join
    nobody, is taken back, and the rest solved again.
    """
    own = [_own_solution(evidence, robot, consistency, gnc) for robot in evidence.robots]
    paths = [path for path, _ in own]
    links = _links(evidence, paths, consistency)
    holding = [link for link in links if link.verdict.dominant]
    while True:
        frames, maps = _frames(len(own), holding)
        inside = _inside(evidence, maps)
        likely = inside & _borne_out(evidence, [weights for _, weights in own], holding)
        solution = _graduated(evidence, likely, paths, frames, gnc)
        solution = _settled(evidence.graph, inside, solution, gnc)
        lone = _lone(evidence, paths, solution, consistency)
        if lone.any():
            trusted = replace(solution, weights=solution.weights * ~lone)
            solution = _settled(evidence.graph, inside, trusted, gnc)
        lasting = [link for link in holding if _lasts(link, paths, solution, evidence.informative, consistency)]
        if len(lasting) == len(holding):
            own_poses: tuple[FloatArray, ...] = tuple(frozen(path.poses) for path in paths)
            return JointSolution(solution.poses, solution.weights, tuple(maps), tuple(links), own_poses)
        holding = lasting


def _own_solution(
    evidence: JointEvidence, robot: NDArray[np.int64], consistency: ConsistencySettings, gnc: GncSettings | None
) -> tuple[Trajectory, FloatArray]:
    """A robot's trajectory by its own measurements, and the weights (E,) of its closures; other edges have 0."""
    graph = evidence.graph
    number = np.full(len(graph), -1)
    number[robot] = np.arange(len(robot))
    edges = graph.arrays()
    mine = np.flatnonzero((number[edges.i] >= 0) & (number[edges.j] >= 0) & ~evidence.excluded)
    alone = PoseGraph(
        graph.poses()[robot],
        [
            Edge(int(number[e.i]), int(number[e.j]), e.T_i_j, e.information, e.robust)
            for e in (graph.edges[k] for k in mine.tolist())
        ],
    )
    solution = solve_alone(alone, consistency, gnc)
    weights = np.zeros(len(edges.i))
    weights[mine] = solution.weights
    return path_of(alone, solution.poses, consistency), weights


def _links(evidence: JointEvidence, own: Sequence[Trajectory], settings: ConsistencySettings) -> list[Link]:
    """Pairwise consistency for every two robots (PCM), on their own trajectories."""
    links = []
    for a, b, rows, closures in _pairs(evidence, evidence.independent & ~evidence.excluded):
        verdict = judge(own[a], own[b], closures, evidence.informative[rows], settings)
        members = closures.only(np.array(verdict.members, dtype=np.int64))
        T_a_b = relative_frame(own[a], own[b], members) if verdict.dominant else None
        links.append(Link(a, b, rows, verdict, closures, T_a_b))
    return links


def _pairs(
    evidence: JointEvidence, chosen: NDArray[np.bool_]
) -> Iterator[tuple[int, int, NDArray[np.int64], Closures]]:
    """Every two robots with chosen closures between them: a, b, the closures' edges, the closures seen from a."""
    edges, (owner, place) = evidence.graph.arrays(), _owners(evidence)
    between = np.flatnonzero(edges.robust & chosen & (owner[edges.i] != owner[edges.j]))
    ends = np.sort(np.stack((owner[edges.i[between]], owner[edges.j[between]])), axis=0)
    for a, b in np.unique(ends, axis=1).T.tolist():
        rows = between[(ends[0] == a) & (ends[1] == b)]
        told = Closures(place[edges.i[rows]], place[edges.j[rows]], edges.T_i_j[rows], edges.information[rows])
        yield a, b, rows, told.turned(owner[edges.i[rows]] == b)


def _frames(count: int, links: Sequence[Link]) -> tuple[list[FloatArray], list[int]]:
    """T_map_own of every robot, and the number of its map: the strongest links first, as a spanning tree grows."""
    frames = [np.zeros(3) for _ in range(count)]
    maps = list(range(count))
    for link in sorted(links, key=lambda link: (-link.verdict.supporters, -len(link.verdict.members), link.a, link.b)):
        older, younger = sorted((maps[link.a], maps[link.b]))
        if older == younger or link.T_a_b is None:
            continue
        # T_mapA_mapB by way of the two robots
        T = se2.compose(se2.compose(frames[link.a], link.T_a_b), se2.inverse(frames[link.b]))
        T = T if maps[link.a] == older else se2.inverse(T)
        for robot in (robot for robot in range(count) if maps[robot] == younger):
            frames[robot], maps[robot] = se2.compose(T, frames[robot]), older
    order = {first: number for number, first in enumerate(dict.fromkeys(maps))}
    return frames, [order[first] for first in maps]


def _inside(evidence: JointEvidence, maps: Sequence[int]) -> NDArray[np.bool_]:
    """Edges (E,) that may count: closures between maps do not, nor do excluded ones."""
    edges, (owner, _) = evidence.graph.arrays(), _owners(evidence)
    map_of = np.array(maps)[owner]
    within: NDArray[np.bool_] = map_of[edges.i] == map_of[edges.j]
    return ~edges.robust | (within & ~evidence.excluded)


def _borne_out(evidence: JointEvidence, own: Sequence[FloatArray], links: Sequence[Link]) -> NDArray[np.bool_]:
    """Odometry, and the closures that a robot alone or a link bears out, (E,)."""
    borne_out = ~evidence.graph.arrays().robust
    for weights in own:
        borne_out |= weights > HOLDS
    for link in links:
        borne_out[link.members] = True
    return borne_out


def _graduated(
    evidence: JointEvidence,
    likely: NDArray[np.bool_],
    own: Sequence[Trajectory],
    frames: Sequence[FloatArray],
    gnc: GncSettings | None,
) -> Solution:
    """Graduated non-convexity with likely closures only: false ones, even if they are most, must not pull at its start.

    From the robots' own solutions, and once more from the chordal one, which drift does not matter to; the cheaper
    result counts. Other closures have weight 0.
    """
    graph = evidence.graph
    start = graph.poses()
    for robot, path, frame in zip(evidence.robots, own, frames, strict=True):
        start[robot] = se2.compose(frame, path.poses)
    placed = _part(graph, start, likely)
    solutions = [optimize_gnc(placed, poses, settings=gnc) for poses in (start, initialize(placed))]
    best = min(solutions, key=lambda solution: solution.stats.final_cost)
    return _spread(best, likely)


def _settled(graph: PoseGraph, inside: NDArray[np.bool_], trusted: Solution, gnc: GncSettings | None) -> Solution:
    """Every closure inside decided by the solution with those that are trusted."""
    part = _part(graph, trusted.poses, inside)
    return _spread(settle(part, None, trusted.weights[inside], settings=gnc), inside)


def _lone(
    evidence: JointEvidence, own: Sequence[Trajectory], solution: Solution, settings: ConsistencySettings
) -> NDArray[np.bool_]:
    """Closures that hold, without a witness, alone in tying down a piece of path, between robots most of whose
    closures do not hold, (E,).

    Of very many false closures one may hit where a path is loose enough to follow it. Where they are many, a lone one
    counts only if the rest predicts it.
    """
    held = solution.weights > HOLDS
    loose = _next_tie_m(evidence, own, held) >= settings.separation_m
    lone = np.zeros(len(held), dtype=bool)
    for a, b, rows, closures in _pairs(evidence, ~evidence.excluded):
        kept = np.flatnonzero(held[rows])
        if 2 * len(kept) < len(rows):
            alone = witnesses(own[a], own[b], closures.only(kept), settings) == 0
            lone[rows[kept]] = alone & loose[rows[kept]]
    return lone


def _next_tie_m(evidence: JointEvidence, own: Sequence[Trajectory], held: NDArray[np.bool_]) -> FloatArray:
    """Path from the worse end of each closure that holds to the next end of another one, (E,); 0 for other edges."""
    edges, (owner, place) = evidence.graph.arrays(), _owners(evidence)
    closures = np.flatnonzero(edges.robust & held)
    ends = np.concatenate((edges.i[closures], edges.j[closures]))
    gap = np.full(len(ends), np.inf)
    for robot, path in enumerate(own):
        mine = np.flatnonzero(owner[ends] == robot)
        mine = mine[np.argsort(path.metres[place[ends[mine]]], kind="stable")]
        between = np.diff(path.metres[place[ends[mine]]])
        gap[mine] = np.minimum(np.append(between, np.inf), np.append(np.inf, between))
    tie = np.zeros(len(edges.i))
    tie[closures] = gap.reshape(2, -1).max(axis=0)
    return tie


def _lasts(
    link: Link,
    own: Sequence[Trajectory],
    solution: Solution,
    informative: NDArray[np.bool_],
    settings: ConsistencySettings,
) -> bool:
    """Whether more than two thirds of the link's cluster hold in the joint solution, and would be enough to join."""
    holds = np.flatnonzero(solution.weights[link.members] > HOLDS)
    held = np.array(link.verdict.members, dtype=np.int64)[holds]
    supporters = apart(places_of(own[link.a], own[link.b], link.closures.only(held)), settings.separation_m)
    enough = supporters >= settings.minimum_closures and bool(informative[link.edges[held]].any())
    return 3 * len(held) > 2 * len(link.members) and enough


def _owners(evidence: JointEvidence) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Robot of each variable and its place on the robot's path, shape (N,) each."""
    owner, place = np.full((2, len(evidence.graph)), -1)
    for number, variables in enumerate(evidence.robots):
        owner[variables], place[variables] = number, np.arange(len(variables))
    return owner, place


def _part(graph: PoseGraph, poses: FloatArray, kept: NDArray[np.bool_]) -> PoseGraph:
    """All variables, at ``poses``, and some of the edges."""
    return PoseGraph(poses, [edge for edge, keep in zip(graph.edges, kept.tolist(), strict=True) if keep])


def _spread(solution: Solution, kept: NDArray[np.bool_]) -> Solution:
    """The solution of a part, told of the whole graph: edges left out have weight 0."""
    weights = np.zeros(len(kept))
    weights[kept] = solution.weights
    return replace(solution, weights=frozen(weights))
