"""Chains of a pose graph: variables that only odometry measures, between two that closures or branches fix.

Such a chain acts on the rest as one edge, so a solve needs its two ends alone. Most keyscans are inside of one.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fcslam.geometry import se2
from fcslam.graph.pose_graph import EdgeArrays, PoseGraph
from fcslam.graph.trajectory import transport_covariance
from fcslam.records import FloatArray

LONGEST = 16
"""Most edges of a chain: the combined edge holds to first order in the errors of its parts."""

Step = tuple[NDArray[np.int64], NDArray[np.int64], FloatArray, FloatArray, FloatArray]
"""One edge in each of K chains: the chains and the variables at its end, shape (K,) each, its motion (K, 3) and
covariance (K, 3, 3), and what takes a tangent vector at its end to one at the end of the chain, shape (K, 3, 3)."""


@dataclass(frozen=True, slots=True, eq=False)
class Chains:
    """The chains of a graph with N variables, one or more edges long; together they hold every trusted edge once."""

    kept: NDArray[np.int64]
    """Variables that are not inside of a chain, ascending, shape (M,)."""
    i: NDArray[np.int64]
    """First variable of each chain, shape (C,)."""
    j: NDArray[np.int64]
    """Last variable of each chain, shape (C,)."""
    T_i_j: FloatArray
    """Motion along each chain, shape (C, 3)."""
    information: FloatArray
    """Information of that motion in the tangent space at it, shape (C, 3, 3)."""
    steps: tuple[Step, ...]
    """The first edges of all chains, then the second ones of those that have one, and so on."""

    def contract(self, graph: PoseGraph) -> PoseGraph:
        """The variables that are not inside of a chain, with new numbers, and one edge for each chain.

        Args:
            graph: that of these chains, with all or some of its closures.
        """
        edges = graph.arrays()
        closures, number = edges.robust, np.zeros(len(graph), dtype=np.int64)
        number[self.kept] = np.arange(len(self.kept))
        return PoseGraph.restored(
            graph.poses()[self.kept],
            EdgeArrays(
                i=number[np.concatenate((self.i, edges.i[closures]))],
                j=number[np.concatenate((self.j, edges.j[closures]))],
                T_i_j=np.concatenate((self.T_i_j, edges.T_i_j[closures])),
                information=np.concatenate((self.information, edges.information[closures])),
                robust=np.arange(len(self.i) + np.count_nonzero(closures)) >= len(self.i),
            ),
        )

    def expand(self, poses: FloatArray) -> None:
        """Set the poses inside of the chains, in ``poses`` (N, 3), to the optimum for those at their ends.

        A chain's misfit goes to its edges in proportion to their covariances, to first order.
        """
        misfit = se2.log(se2.between(self.T_i_j, se2.between(poses[self.i], poses[self.j])))
        pull = np.einsum("cab,cb->ca", self.information, misfit)
        at = poses[self.i]
        for chains, j, T_i_j, covariance, to_end in self.steps:
            # The pull at the end of the chain, in the tangent space at the end of this edge.
            here = np.einsum("cba,cb->ca", to_end, pull[chains])
            correction = np.einsum("cab,cb->ca", covariance, here)
            at[chains] = se2.compose(at[chains], se2.compose(T_i_j, se2.exp(correction)))
            inside = j != self.j[chains]
            poses[j[inside]] = at[chains[inside]]


def find_chains(graph: PoseGraph) -> Chains:
    """Combine the trusted edges of a graph wherever nothing else measures the variables between them."""
    edges = graph.arrays()
    following = _following_edges(edges, len(graph))
    inside = np.zeros(len(graph), dtype=bool)
    trusted = np.flatnonzero(~edges.robust)
    continued = trusted[following[trusted] >= 0]
    inside[edges.j[continued]] = True
    # Walk along all chains at a time; one that is longer than the limit ends, and another one begins.
    walked: list[tuple[NDArray[np.int64], NDArray[np.int64]]] = []
    current = trusted[~inside[edges.i[trusted]]]
    starts, chains = [current], np.arange(len(current))
    while len(current):
        walked.append((chains, current))
        going = following[current] >= 0
        chains, current = chains[going], following[current[going]]
        if len(walked) % LONGEST == 0:
            inside[edges.i[current]] = False
            chains = sum(map(len, starts)) + np.arange(len(current))
            starts.append(current)
    return _combined(edges, np.concatenate(starts), walked, np.flatnonzero(~inside))


def _following_edges(edges: EdgeArrays, count: int) -> NDArray[np.int64]:
    """The trusted edge after each trusted edge where nothing else measures the variable between, else -1; (E,)."""
    closed = np.zeros(count, dtype=bool)
    closed[edges.i[edges.robust]] = True
    closed[edges.j[edges.robust]] = True
    trusted = np.flatnonzero(~edges.robust)
    leaving = np.bincount(edges.i[trusted], minlength=count)
    arriving = np.bincount(edges.j[trusted], minlength=count)
    next_edge = np.full(count, -1)
    next_edge[edges.i[trusted]] = trusted
    # Ascending numbers: so the first variable of a component, which anchors it, is not inside of a chain.
    only_passed = ~closed & (leaving == 1) & (arriving == 1)
    following = np.full(len(edges.i), -1)
    j = edges.j[trusted]
    after = next_edge[j]
    passes = only_passed[j] & (edges.i[trusted] < j) & (j < edges.j[after])
    following[trusted[passes]] = after[passes]
    return following


def _combined(
    edges: EdgeArrays,
    starts: NDArray[np.int64],
    walked: list[tuple[NDArray[np.int64], NDArray[np.int64]]],
    kept: NDArray[np.int64],
) -> Chains:
    """Motion and information of each chain, from the edges in the order in which they were walked."""
    count = len(starts)
    T_i_j, covariance, j = np.zeros((count, 3)), np.zeros((count, 3, 3)), np.zeros(count, dtype=np.int64)
    covariances = np.asarray(np.linalg.inv(edges.information), dtype=np.float64)
    for chains, rows in walked:
        T_i_j[chains] = se2.compose(T_i_j[chains], edges.T_i_j[rows])
        covariance[chains] = transport_covariance(covariance[chains], edges.T_i_j[rows]) + covariances[rows]
        j[chains] = edges.j[rows]
    to_end = np.tile(np.eye(3), (count, 1, 1))
    steps = []
    for chains, rows in reversed(walked):
        steps.append((chains, edges.j[rows], edges.T_i_j[rows], covariances[rows], to_end[chains]))
        to_end[chains] = to_end[chains] @ se2.adjoint(se2.inverse(edges.T_i_j[rows]))
    information = np.linalg.inv(covariance)
    symmetric = np.asarray(0.5 * (information + information.swapaxes(-1, -2)), dtype=np.float64)
    return Chains(kept, edges.i[starts], j, T_i_j, symmetric, tuple(reversed(steps)))
