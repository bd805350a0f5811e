"""Robots whose paths contradict the others: their closures hold one by one, but fit no joint solution.

A robot that measures wrongly, or lies, passes every test of a single closure: a copy of another robot's data, scaled by
a few percent, matches everywhere. Solved jointly, its closures bend the paths of the others. The residuals show it:
they point the same way along whole stretches of a path. Residuals of a noisy scanner are as long, but those of one
constraint say nothing about those of the next. So strain is the part of the chi-square that constraints share with
their neighbours along the path. Closures between two robots show it where both paths are stiff, and a robot's own
measurements show it where its path gives way.

The choice of the robots that leave minimises a truncated loss, as graduated non-convexity does for single closures. A
robot that stays costs the chi-square of its constraints in the joint solution. A robot that leaves costs the limit for
each of its closures with the others.
"""

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from fcslam.geometry import se2
from fcslam.graph.factors import FactorCache
from fcslam.graph.optimizer import optimize
from fcslam.graph.pose_graph import PoseGraph
from fcslam.records import FloatArray

Strains = Mapping[tuple[int, int], float]
"""Shared chi-square of the closures between two robots a < b, or of the own measurements of a robot a = b."""
_REACH = 2
"""Constraints before and after one, along the path, that are its neighbours."""


def strained_pairs(
    graph: PoseGraph, owner: NDArray[np.int64], poses: FloatArray, kept: NDArray[np.bool_], limit: float
) -> Strains:
    """Pairs of robots with closures between them, and robots that have such closures, whose strain is over the limit.

    Args:
        graph: N variables and E edges.
        owner: robot of each variable, shape (N,).
        poses: shape (N, 3), metres and radians.
        kept: edges that count, shape (E,).
        limit: largest strain.
    """
    edges = graph.arrays()
    between = _between(graph, owner) & kept
    joined = np.unique(owner[np.concatenate((edges.i[between], edges.j[between]))])
    own = ~edges.robust & kept & np.isin(owner[edges.i], joined)
    rows = np.flatnonzero(between | own)
    if not len(rows):
        return {}
    i, j = edges.i[rows], edges.j[rows]
    is_reversed = owner[i] > owner[j]
    first, second = np.where(is_reversed, j, i), np.where(is_reversed, i, j)
    residuals = np.where(is_reversed, -1.0, 1.0)[:, None] * _whitened_in_map(graph, poses, rows)
    order = np.lexsort((second, first, owner[second], owner[first]))
    pairs, begins = np.unique(np.stack((owner[first], owner[second]))[:, order], axis=1, return_index=True)
    strains = [shared_chi2(part) for part in np.split(residuals[order], begins[1:])]
    return {(int(a), int(b)): strain for (a, b), strain in zip(pairs.T, strains, strict=True) if strain > limit}


def _between(graph: PoseGraph, owner: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Closures between two robots, shape (E,)."""
    edges = graph.arrays()
    between: NDArray[np.bool_] = edges.robust & (owner[edges.i] != owner[edges.j])
    return between


def shared_chi2(residuals: FloatArray) -> float:
    """Mean product of each whitened residual with the mean of its neighbours, less its standard error; 0 for fewer than
    three.

    It is the mean chi-square if all residuals are equal, and about 0 if they are independent.

    Args:
        residuals: shape (K, 3), in the order of the path.
    """
    count = len(residuals)
    if count < 3:
        return 0.0
    neighbours, number = np.zeros_like(residuals), np.zeros((count, 1))
    for step in range(1, _REACH + 1):
        neighbours[step:] += residuals[:-step]
        neighbours[:-step] += residuals[step:]
        number[step:] += 1
        number[:-step] += 1
    products = np.sum(residuals * neighbours / number, axis=1)
    return float(products.mean() - products.std() / np.sqrt(count))


def _whitened_in_map(graph: PoseGraph, poses: FloatArray, rows: NDArray[np.int64]) -> FloatArray:
    """Residuals of some edges, shape (K, 3), along the axes of the map and in units of their stated noise."""
    edges = graph.arrays()
    j = edges.j[rows]
    residuals = se2.log(se2.between(edges.T_i_j[rows], se2.between(poses[edges.i[rows]], poses[j])))
    cos, sin = np.cos(poses[j, 2]), np.sin(poses[j, 2])
    turns = np.zeros((len(rows), 3, 3))
    turns[:, 0, 0], turns[:, 0, 1], turns[:, 1, 0], turns[:, 1, 1], turns[:, 2, 2] = cos, -sin, sin, cos, 1.0
    information = turns @ edges.information[rows] @ turns.swapaxes(1, 2)
    whitened: FloatArray = np.einsum("kba,kbc,kc->ka", np.linalg.cholesky(information), turns, residuals)
    return whitened


def contradicting_robots(
    factors: FactorCache, owner: NDArray[np.int64], poses: FloatArray, kept: NDArray[np.bool_], limit: float
) -> dict[int, Strains]:
    """Find the robots that leave the maps of those that they contradict, by a greedy minimum of the truncated loss.

    Nobody leaves while nothing is strained. Of equal ones, the robot that started later leaves.

    Args:
        factors: of a graph with N variables and E edges.
        owner: robot of each variable, shape (N,).
        poses: a joint solution, shape (N, 3), metres and radians.
        kept: edges that count in it, shape (E,).
        limit: strain over which robots contradict, and the cost of a closure that is given up.

    Returns:
        The robots in the order in which they leave. Each has the largest strain at that moment for every pair of it and
        a robot that it contradicts.
    """
    graph = factors.graph
    edges, left = graph.arrays(), dict[int, Strains]()
    between = _between(graph, owner)
    while strained := strained_pairs(graph, owner, poses, kept, limit):
        least, worst = graph.chi2(poses)[kept].sum(), -1
        ends = owner[edges.i[between & kept]], owner[edges.j[between & kept]]
        for robot in np.unique(ends)[::-1].tolist():
            given_up = kept & between & ((owner[edges.i] == robot) | (owner[edges.j] == robot))
            without = optimize(graph, poses, kept=kept & ~given_up, factors=factors).poses
            loss = graph.chi2(without)[kept & ~given_up].sum() + limit * np.count_nonzero(given_up)
            if loss < least:
                least, worst, remaining, best = loss, robot, kept & ~given_up, without
        if worst < 0:
            break
        left[worst] = dict.fromkeys(
            _contradicted(worst, graph, owner, poses, kept & between, limit), max(strained.values())
        )
        kept, poses = remaining, best
    return left


def _contradicted(
    robot: int, graph: PoseGraph, owner: NDArray[np.int64], poses: FloatArray, between: NDArray[np.bool_], limit: float
) -> list[tuple[int, int]]:
    """Pairs a < b of this robot and others whose closures have a mean chi-square over the limit, at least the worst."""
    edges, chi2 = graph.arrays(), graph.chi2(poses)
    mine = np.flatnonzero(between & ((owner[edges.i] == robot) | (owner[edges.j] == robot)))
    others = owner[edges.i[mine]] + owner[edges.j[mine]] - robot
    means = {other: chi2[mine[others == other]].mean() for other in np.unique(others).tolist()}
    least = min(limit, max(means.values()))
    return [(min(robot, other), max(robot, other)) for other, mean in means.items() if mean >= least]
