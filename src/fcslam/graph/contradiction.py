"""Robots whose paths contradict each other: the closures between them fit no pair of paths, though each fits somewhere.

A robot that measures wrongly, or lies, passes every test of a single closure: a copy of another robot's data, scaled by
a few percent, matches everywhere. Solved together, its closures bend the others. The residuals of the closures that
two robots agree on tell: those of true paths are far below the closures' stated noise, which is a bound for the worst
place, and those of contradicting paths reach it everywhere.
"""

from collections.abc import Iterator, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from fcslam.graph.optimizer import GncSettings, refine_inliers
from fcslam.graph.pose_graph import Edge, PoseGraph
from fcslam.records import FloatArray

_KEPT = 0.5
"""Weight above which a closure counts."""

_UNCONFIRMED = 2.0
"""Two robots that only each other contradict, nobody else either of them, need this many times the limit."""

Contradictions = Mapping[tuple[int, int], float]
"""Mean chi-square of the closures between two robots a < b whose paths contradict each other."""


def strained_pairs(
    graph: PoseGraph, owner: NDArray[np.int64], poses: FloatArray, kept: NDArray[np.bool_], limit: float
) -> Contradictions:
    """Pairs of robots that poses strain: the mean chi-square of the closures between them is over the limit.

    A necessary condition of a contradiction: the two alone could only fit better.

    Args:
        graph: N variables and E edges.
        owner: robot of each variable, shape (N,).
        poses: shape (N, 3), metres and radians.
        kept: edges that count, shape (E,).
        limit: largest mean chi-square.
    """
    edges, chi2 = graph.arrays(), graph.chi2(poses)
    between = np.flatnonzero(edges.robust & kept & (owner[edges.i] != owner[edges.j]))
    ends = np.sort(np.stack((owner[edges.i[between]], owner[edges.j[between]])), axis=0)
    pairs, number, counts = np.unique(ends, axis=1, return_inverse=True, return_counts=True)
    means = np.bincount(number.ravel(), chi2[between], len(counts)) / np.maximum(counts, 1)
    return {(int(a), int(b)): float(mean) for (a, b), mean in zip(pairs.T, means, strict=True) if mean > limit}


def contradictions(
    graph: PoseGraph,
    owner: NDArray[np.int64],
    poses: FloatArray,
    weights: FloatArray,
    within: NDArray[np.bool_],
    limit: float,
    gnc: GncSettings | None = None,
) -> Contradictions:
    """Pairs of robots that contradict each other, whatever the other robots measure.

    Args:
        graph: N variables and E edges.
        owner: robot of each variable, shape (N,).
        poses: a joint solution, shape (N, 3), metres and radians.
        weights: its weights, shape (E,).
        within: edges that may count, shape (E,).
        limit: largest mean chi-square of the closures between two robots, solved without the others.
        gnc: threshold of inliers.
    """
    found = {}
    for a, b in strained_pairs(graph, owner, poses, weights > _KEPT, limit):
        mean = _pair_strain(graph, owner, (a, b), poses, weights, within, gnc)
        if mean > limit:
            found[a, b] = mean
    return found


def _pair_strain(
    graph: PoseGraph,
    owner: NDArray[np.int64],
    pair: tuple[int, int],
    poses: FloatArray,
    weights: FloatArray,
    within: NDArray[np.bool_],
    gnc: GncSettings | None,
) -> float:
    """Mean chi-square of the inliers between two robots in the solution of these two alone."""
    edges = graph.arrays()
    variables = np.flatnonzero(np.isin(owner, pair))
    number = np.full(len(graph), -1)
    number[variables] = np.arange(len(variables))
    rows = np.flatnonzero(within & (number[edges.i] >= 0) & (number[edges.j] >= 0))
    chosen = (graph.edges[row] for row in rows.tolist())
    two = PoseGraph(
        poses[variables], [Edge(int(number[e.i]), int(number[e.j]), e.T_i_j, e.information, e.robust) for e in chosen]
    )
    solution = refine_inliers(two, None, weights[rows], settings=gnc)
    between = owner[edges.i[rows]] != owner[edges.j[rows]]
    chi2 = two.chi2(solution.poses)[between & (solution.weights > _KEPT)]
    return float(chi2.mean()) if len(chi2) else 0.0


def confirmed(found: Contradictions, senders: Sequence[int], limit: float) -> Contradictions:
    """The contradictions that others confirm, because they contradict one of the two robots as well, or that are clear.

    Args:
        found: contradicting pairs.
        senders: as for ``leaving``.
        limit: largest mean chi-square of a pair that does not contradict.
    """
    against = {robot: len(set(others)) for robot, others in _by_robot(set(found), senders)}
    return {
        (a, b): mean for (a, b), mean in found.items() if mean > _UNCONFIRMED * limit or max(against[a], against[b]) > 1
    }


def leaving(found: Contradictions, senders: Sequence[int]) -> dict[int, int]:
    """Which robots leave the maps of those that they contradict, and how many others contradict each.

    The robot that most others contradict leaves first, until no two that stay contradict each other. Those that equally
    many contradict leave together: with nobody else to ask, it is open which of two is wrong.

    Args:
        found: contradicting pairs.
        senders: who sent each robot's packets; robots of one sender, its sessions, count as one.
    """
    left: dict[int, int] = {}
    open_pairs = set(found)
    while open_pairs:
        against = {robot: len(set(others)) for robot, others in _by_robot(open_pairs, senders)}
        most = max(against.values())
        left |= {robot: count for robot, count in against.items() if count == most}
        open_pairs = {pair for pair in open_pairs if not left.keys() & set(pair)}
    return left


def _by_robot(pairs: set[tuple[int, int]], senders: Sequence[int]) -> Iterator[tuple[int, list[int]]]:
    """Every robot of a pair, and the senders of those that contradict it."""
    for robot in sorted({robot for pair in pairs for robot in pair}):
        yield robot, [senders[b if a == robot else a] for a, b in pairs if robot in (a, b)]
