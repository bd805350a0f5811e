"""Robots whose paths contradict each other: the closures between them fit no pair of paths, though each fits somewhere.

A robot that measures wrongly, or lies, passes every test of a single closure: a copy of another robot's data, scaled by
a few percent, matches everywhere. Solved together, its closures bend the others. The residuals of the closures that
two robots agree on tell: those of true paths are far below the closures' stated noise, which is a bound for the worst
place, and those of contradicting paths reach it everywhere.
"""

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from fcslam.graph.optimizer import GncSettings, refine_inliers
from fcslam.graph.pose_graph import Edge, PoseGraph
from fcslam.records import FloatArray

_KEPT = 0.5
"""Weight above which a closure counts."""

_UNCONFIRMED = 2.0
"""Two robots that only each other contradict, nobody else either of them, need this many times the limit."""

_CLEARLY_WORSE = 3.0
"""Of two robots that contradict each other, the one that fits the others so many times worse is wrong."""

Strains = Mapping[tuple[int, int], float]
"""Mean chi-square of the closures between two robots a < b."""


def strained_pairs(
    graph: PoseGraph, owner: NDArray[np.int64], poses: FloatArray, kept: NDArray[np.bool_], limit: float
) -> Strains:
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


def strains(
    graph: PoseGraph,
    owner: NDArray[np.int64],
    poses: FloatArray,
    weights: FloatArray,
    within: NDArray[np.bool_],
    limit: float,
    gnc: GncSettings | None = None,
) -> Strains:
    """How well every two robots fit together, whatever the other robots measure; nothing if all fit.

    Args:
        graph: N variables and E edges.
        owner: robot of each variable, shape (N,).
        poses: a joint solution, shape (N, 3), metres and radians.
        weights: its weights, shape (E,).
        within: edges that may count, shape (E,).
        limit: largest mean chi-square in the joint solution at which two robots fit; then they fit alone as well.
        gnc: threshold of inliers.

    Returns:
        Mean chi-square of the closures between any two robots, solved without the others.
    """
    kept = weights > _KEPT
    if not strained_pairs(graph, owner, poses, kept, limit):
        return {}
    every = strained_pairs(graph, owner, poses, kept, 0.0)
    return {pair: _pair_strain(graph, owner, pair, poses, weights, within, gnc) for pair in every}


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


def contradictions(found: Strains, senders: Sequence[int], limit: float) -> Strains:
    """The pairs of robots that contradict each other.

    Their mean chi-square is over the limit, and a third robot contradicts one of them as well, or it is over twice the
    limit.

    Args:
        found: all pairs.
        senders: who sent each robot's packets; robots of one sender, its sessions, count as one.
        limit: largest mean chi-square of two robots that fit.
    """
    over = {pair: mean for pair, mean in found.items() if mean > limit}
    against = _against(over, senders)
    return {
        (a, b): mean for (a, b), mean in over.items() if mean > _UNCONFIRMED * limit or max(against[a], against[b]) > 1
    }


def leaving(contradicting: Strains, found: Strains, senders: Sequence[int]) -> dict[int, int]:
    """Which robots leave the maps of those that they contradict, and how many others contradict each.

    The robot that most others contradict leaves first, until no two that stay contradict each other. Of those that
    equally many contradict, the one leaves that fits the others clearly worse. If none does, it is open which of them
    is wrong, and all leave.

    Args:
        contradicting: pairs that contradict each other.
        found: all pairs.
        senders: as for ``contradictions``.
    """
    left: dict[int, int] = {}
    pairs = contradicting
    while pairs:
        against = _against(pairs, senders)
        most = max(against.values())
        equal = {robot for robot, count in against.items() if count == most}
        misfit = dict.fromkeys(equal, 0.0)
        for pair, mean in found.items():
            for robot in equal.intersection(pair) if len(equal.intersection(pair)) == 1 else ():
                misfit[robot] = max(misfit[robot], mean)
        worst = max(misfit.values())
        left |= {robot: most for robot in equal if _CLEARLY_WORSE * misfit[robot] >= worst}
        pairs = {pair: mean for pair, mean in pairs.items() if left.keys().isdisjoint(pair)}
    return left


def _against(pairs: Strains, senders: Sequence[int]) -> dict[int, int]:
    """How many senders contradict each robot."""
    others: dict[int, set[int]] = {}
    for a, b in pairs:
        others.setdefault(a, set()).add(senders[b])
        others.setdefault(b, set()).add(senders[a])
    return {robot: len(others[robot]) for robot in sorted(others)}
