"""Several robots in one graph: who shares a map, which closures hold, where everybody is.

Most closures between robots may be false, and false ones may agree with one another. Nothing is known of how the
robots' frames lie to each other. Pairwise consistency says it, graduated non-convexity decides every closure.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from fcslam.geometry import se2
from fcslam.graph.alone import path_of, solve_alone
from fcslam.graph.cluster import ClusterVerdict, apart, judge, places_of, relative_frame
from fcslam.graph.consistency import Closures, ConsistencySettings
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


def solve_jointly(
    evidence: JointEvidence, consistency: ConsistencySettings, gnc: GncSettings | None = None
) -> JointSolution:
    """Poses, maps and closures that hold, from the evidence alone: no earlier estimate plays a part.

    A link whose cluster loses too many members in the joint solution is taken back, and the rest solved again.
    """
    own = [_own_solution(evidence, robot, consistency, gnc) for robot in evidence.robots]
    links = _links(evidence, [path for path, _ in own], consistency)
    holding = [link for link in links if link.verdict.dominant]
    while True:
        frames, maps = _frames(len(own), holding)
        solution = _decide(evidence, own, frames, maps, holding, gnc)
        lasting = [link for link in holding if _lasts(link, own, solution, evidence.informative, consistency)]
        if len(lasting) == len(holding):
            return JointSolution(solution.poses, solution.weights, tuple(maps), tuple(links))
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
    edges = evidence.graph.arrays()
    owner, place = _owners(evidence)
    usable = edges.robust & evidence.independent & ~evidence.excluded
    links = []
    for a, b in combinations(range(len(own)), 2):
        rows = np.flatnonzero(usable & np.isin(owner[edges.i], (a, b)) & np.isin(owner[edges.j], (a, b)))
        rows = rows[owner[edges.i[rows]] != owner[edges.j[rows]]]
        if not len(rows):
            continue
        told = Closures(place[edges.i[rows]], place[edges.j[rows]], edges.T_i_j[rows], edges.information[rows])
        closures = told.turned(owner[edges.i[rows]] == b)
        verdict = judge(own[a], own[b], closures, evidence.informative[rows], settings)
        members = closures.only(np.array(verdict.members, dtype=np.int64))
        T_a_b = relative_frame(own[a], own[b], members) if verdict.dominant else None
        links.append(Link(a, b, rows, verdict, closures, T_a_b))
    return links


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


def _decide(
    evidence: JointEvidence,
    own: Sequence[tuple[Trajectory, FloatArray]],
    frames: Sequence[FloatArray],
    maps: Sequence[int],
    links: Sequence[Link],
    gnc: GncSettings | None,
) -> Solution:
    """Decide every closure within a map; closures between maps count for nothing.

    Graduated non-convexity runs with the closures that each robot alone or a link bears out, so that false ones,
    even if they are most, do not pull at its start; then the solution decides about all. It starts from the robots' own
    solutions, and once more from the chordal one, which drift does not matter to; the cheaper result counts.
    """
    graph = evidence.graph
    edges, (owner, _) = graph.arrays(), _owners(evidence)
    start = graph.poses()
    for robot, (path, _), frame in zip(evidence.robots, own, frames, strict=True):
        start[robot] = se2.compose(frame, path.poses)
    map_of = np.array(maps)[owner]
    inside = ~edges.robust | (map_of[edges.i] == map_of[edges.j]) & ~evidence.excluded
    borne_out = ~edges.robust
    for _, weights in own:
        borne_out |= weights > HOLDS
    for link in links:
        borne_out[link.members] = True
    placed = PoseGraph(start, _part(graph, borne_out & inside).edges)
    solutions = [optimize_gnc(placed, poses, settings=gnc) for poses in (start, initialize(placed))]
    first = min(solutions, key=lambda solution: solution.stats.final_cost)
    trusted = np.zeros(len(edges.i))
    trusted[borne_out & inside] = first.weights
    solution = settle(_part(graph, inside), first.poses, trusted[inside], settings=gnc)
    weights = np.zeros(len(edges.i))
    weights[inside] = solution.weights
    return Solution(solution.poses, frozen(weights), solution.stats)


def _lasts(
    link: Link,
    own: Sequence[tuple[Trajectory, FloatArray]],
    solution: Solution,
    informative: NDArray[np.bool_],
    settings: ConsistencySettings,
) -> bool:
    """Whether what is left of the link's cluster in the joint solution would still be enough to join the two."""
    held = np.array([k for k in link.verdict.members if solution.weights[link.edges[k]] > HOLDS], dtype=np.int64)
    places = places_of(own[link.a][0], own[link.b][0], link.closures.only(held))
    supporters = apart(places, settings.separation_m)
    return supporters >= settings.minimum_closures and bool(informative[link.edges[held]].any())


def _owners(evidence: JointEvidence) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Robot of each variable and its place on the robot's path, shape (N,) each."""
    owner, place = np.full((2, len(evidence.graph)), -1)
    for number, variables in enumerate(evidence.robots):
        owner[variables], place[variables] = number, np.arange(len(variables))
    return owner, place


def _part(graph: PoseGraph, kept: NDArray[np.bool_]) -> PoseGraph:
    """All variables and some of the edges."""
    return PoseGraph(graph.poses(), [edge for edge, keep in zip(graph.edges, kept, strict=True) if keep])
