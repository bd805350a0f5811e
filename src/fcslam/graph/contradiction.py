"""Robots whose paths contradict the others: their closures hold one by one, but fit no joint solution.

A robot that measures wrongly, or lies, passes every test of a single closure: a copy of another robot's data, scaled by
a few percent, matches everywhere. Solved jointly, its closures bend the paths of the others. The residuals show it. The
closures' stated noise is a bound for the worst place. Residuals between correct paths are far below it, and those
between contradicting paths reach it everywhere.

The choice of the robots that leave minimises a truncated loss, as graduated non-convexity does for single closures. A
robot that stays costs the chi-square of its constraints in the joint solution. A robot that leaves costs the limit for
each of its closures with the others.
"""

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from fcslam.graph.factors import FactorCache
from fcslam.graph.optimizer import optimize
from fcslam.graph.pose_graph import PoseGraph
from fcslam.records import FloatArray

Strains = Mapping[tuple[int, int], float]
"""Mean chi-square of the closures between two robots a < b."""


def strained_pairs(
    graph: PoseGraph, owner: NDArray[np.int64], poses: FloatArray, kept: NDArray[np.bool_], limit: float
) -> Strains:
    """Pairs of robots for which the mean chi-square of the closures between them is over the limit.

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


def contradicting_robots(
    factors: FactorCache, owner: NDArray[np.int64], poses: FloatArray, kept: NDArray[np.bool_], limit: float
) -> dict[int, Strains]:
    """Find the robots that leave the maps of those that they contradict, by a greedy minimum of the truncated loss.

    Nobody leaves while no pair of robots is strained. Of equal ones, the robot that started later leaves.

    Args:
        factors: of a graph with N variables and E edges.
        owner: robot of each variable, shape (N,).
        poses: a joint solution, shape (N, 3), metres and radians.
        kept: edges that count in it, shape (E,).
        limit: mean chi-square over which a pair of robots is strained, and the cost of a closure that is given up.

    Returns:
        The robots in the order in which they leave, each with its strained pairs at that moment.
    """
    graph = factors.graph
    edges, left = graph.arrays(), dict[int, Strains]()
    between = edges.robust & (owner[edges.i] != owner[edges.j])
    while strained := strained_pairs(graph, owner, poses, kept, limit):
        least, worst = graph.chi2(poses)[kept].sum(), -1
        for robot in sorted({robot for pair in strained for robot in pair}, reverse=True):
            given_up = kept & between & ((owner[edges.i] == robot) | (owner[edges.j] == robot))
            without = optimize(graph, poses, kept=kept & ~given_up, factors=factors).poses
            loss = graph.chi2(without)[kept & ~given_up].sum() + limit * np.count_nonzero(given_up)
            if loss < least:
                least, worst, remaining, best = loss, robot, kept & ~given_up, without
        if worst < 0:
            break
        left[worst] = {pair: mean for pair, mean in strained.items() if worst in pair}
        kept, poses = remaining, best
    return left
