"""Optimal poses of a pose graph: Levenberg-Marquardt, and graduated non-convexity against false closures.

Gauge: each connected component keeps the initial pose of its first variable.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from fcslam.geometry import se2
from fcslam.geometry.groups import SE2
from fcslam.graph.least_squares import Loss, minimize
from fcslam.graph.pose_graph import EdgeArrays, PoseGraph
from fcslam.records import FloatArray, frozen

_MAXIMUM_ITERATIONS = 100
"""Limit of Levenberg-Marquardt's iterations; it converges long before."""
_BINARY = 1e-4
"""Distance from 0 or 1 at which a weight is decided."""
INLIER_WEIGHT = 0.5
"""Weight above which a closure is an inlier: graduated non-convexity ends at weight 1 (inlier) or 0 (outlier)."""
_REFINEMENT_ROUNDS = 2 * _MAXIMUM_ITERATIONS
"""Limit of alternating solves and decisions, which end by themselves."""
_FIRST_ITERATIONS = 5
"""Solver iterations of graduated non-convexity with all closures, before steps of one iteration each."""
_CONTROL_STEP = 1.4
"""Factor of its control parameter from step to step, which sharpens the loss."""


@dataclass(frozen=True, slots=True, eq=False)
class Solution:
    """Optimized poses and the weight of each edge."""

    poses: FloatArray
    """Shape (N, P)."""
    weights: FloatArray
    """Shape (E,), in [0, 1]; 1 for odometry."""
    iterations: int
    """Solver iterations of all steps together."""
    cost: float
    """Half the sum of the edges' losses at the poses."""


def optimize(graph: PoseGraph, initial: ArrayLike | None = None, *, loss: Loss = Loss.SQUARED) -> Solution:
    """Optimize a pose graph by Levenberg-Marquardt.

    Args:
        graph: N variables and E edges.
        initial: poses to start from, shape (N, P); None: the graph's own.
        loss: loss of the closures.

    Returns:
        Poses (N, P) and weights (E,).
    """
    steps = _Steps(graph, initial)
    chi2 = steps.solve(np.ones_like(steps.chi2()), _MAXIMUM_ITERATIONS, loss)
    return steps.solution(loss.weights(chi2), steps.cost)


def optimize_gnc(graph: PoseGraph, initial: ArrayLike | None = None) -> Solution:
    """Optimize under the truncated squared loss on closures: each ends at weight 1 (inlier) or 0 (outlier).

    Graduated non-convexity (Yang et al., RA-L 2020, truncated least squares, eqs. 12-14); odometry always counts.

    Each step is one iteration from the poses of the step before. To solve every step to convergence decides as well in
    ten times the time (``benchmarks/robust_graph.py``, m3500 with 100 random false loops). Neither is sure to find the
    best set: the drift of the odometry may favour a false loop.

    ``initial`` is odometry or better. Arguments and result as for ``optimize``.
    """
    steps = _Steps(graph, initial)
    _graduate(steps, steps.solve(np.ones_like(steps.chi2()), _FIRST_ITERATIONS))
    return _alternate(steps, (steps.chi2() <= steps.limit).astype(np.float64))


def refine_inliers(graph: PoseGraph, initial: ArrayLike | None, weights: ArrayLike) -> Solution:
    """Alternate solving and deciding every closure by its residual, until no decision changes.

    The last part of ``optimize_gnc``, from closures that are trusted already: for graphs most of whose closures are
    false, where optimizing with all of them gives no useful start.

    ``weights`` (E,): edges above one half are trusted at the start. Other arguments and result as for ``optimize``.
    """
    trusted = np.asarray(weights, dtype=np.float64)
    if trusted.shape != (graph.edge_count,):
        raise ValueError(f"weights must be of shape ({graph.edge_count},), not {trusted.shape}")
    return _alternate(_Steps(graph, initial), (trusted[graph.arrays().robust] > INLIER_WEIGHT).astype(np.float64))


class _Steps:
    """Solves of one graph, each from the poses of the previous one."""

    def __init__(self, graph: PoseGraph, initial: ArrayLike | None) -> None:
        self.poses = graph.poses() if initial is None else np.array(initial, dtype=np.float64)
        needed, shape = (len(graph), graph.group.size), self.poses.shape
        if shape != needed or not np.isfinite(self.poses).all():
            raise ValueError(f"initial poses must be finite and of shape {needed}, not {shape}")
        self.cost, self.limit = 0.0, graph.group.chi2_limit
        self._graph, self._start, self._iterations = graph, self.poses, 0
        self._robust = np.flatnonzero(graph.arrays().robust)
        self._optimal_for: FloatArray | None = None
        """The weights for which the poses are optimal."""

    def solve(self, weights: FloatArray, iterations: int, loss: Loss = Loss.SQUARED) -> FloatArray:
        """Optimize with closures of these weights, shape (K,), and return ``chi2``; those of weight 0 are left out."""
        if self._optimal_for is None or not np.array_equal(weights, self._optimal_for):
            scale = self._scale(weights)
            edges = self._graph.arrays().select(scale > 0.0)
            edges = replace(edges, information=edges.information * scale[scale > 0.0, None, None])
            held = self._graph.components(scale > 0.0) == np.arange(len(self.poses))
            self.poses, used, self.cost = minimize(
                self._graph.group, edges, self.poses, held, loss=loss, iterations=iterations
            )
            self._iterations += used
            self._optimal_for = weights if used < iterations else None
        return self.chi2()

    def chi2(self) -> FloatArray:
        """Squared Mahalanobis lengths of the closures' residuals, shape (K,)."""
        return self._graph.chi2(self.poses, self._robust)

    def solution(self, weights: FloatArray, cost: float) -> Solution:
        """The poses, each connected component moved so that its first variable is where it started."""
        scale, start, poses, group = self._scale(weights), self._start, self.poses, self._graph.group
        first = self._graph.components(scale > 0.0)
        moved = group.compose(group.compose(start[first], group.inverse(poses[first])), poses)
        moved[first] = start[first]
        return Solution(frozen(moved), frozen(scale), self._iterations, cost)

    def truncated_cost(self) -> float:
        """Cost with the truncated squared loss on closures."""
        chi2 = self._graph.chi2(self.poses)
        chi2[self._robust] = np.minimum(chi2[self._robust], self.limit)
        return 0.5 * float(chi2.sum())

    def _scale(self, weights: FloatArray) -> FloatArray:
        """Weights of all edges, shape (E,), from those of the closures, shape (K,)."""
        scale = np.ones(self._graph.edge_count)
        scale[self._robust] = weights
        return scale


def _graduate(steps: _Steps, chi2: FloatArray) -> None:
    largest = chi2.max(initial=0.0)
    if largest <= steps.limit:
        return
    mu = steps.limit / (2.0 * largest - steps.limit)
    for _ in range(_MAXIMUM_ITERATIONS):  # closures that are then still undecided are decided by their residuals
        weights = _truncated_weights(chi2, mu, steps.limit)
        if np.all((weights < _BINARY) | (weights > 1.0 - _BINARY)):
            return
        chi2 = steps.solve(weights, iterations=1)
        mu *= _CONTROL_STEP


def _alternate(steps: _Steps, weights: FloatArray) -> Solution:
    """Alternate solve and decision until no decision changes, each of which lowers the truncated loss."""
    for _ in range(_REFINEMENT_ROUNDS):
        decided = (steps.solve(weights, _MAXIMUM_ITERATIONS) <= steps.limit).astype(np.float64)
        if np.array_equal(decided, weights):
            break
        weights = decided
    steps.solve(weights, _MAXIMUM_ITERATIONS)
    return steps.solution(weights, steps.truncated_cost())


def _truncated_weights(chi2: FloatArray, mu: float, limit: float) -> FloatArray:
    """Weights of the surrogate of the squared loss truncated at ``limit``, at ``mu`` (Yang et al. 2020, eq. 14)."""
    with np.errstate(divide="ignore"):
        between = np.sqrt(limit * mu * (mu + 1.0) / chi2) - mu
    return np.clip(between, 0.0, 1.0)


@dataclass(frozen=True, slots=True, eq=False)
class PosePrior:
    """A measured pose of one variable."""

    variable: int
    pose: FloatArray
    """Shape (3,), metres and radians."""
    information: FloatArray
    """Inverse covariance in the coordinates of the frame outside (x, y) and of the heading, shape (3, 3)."""

    def chi2(self, poses: FloatArray) -> float:
        """Squared Mahalanobis distance of the poses (N, 3)."""
        residual = poses[self.variable] - self.pose
        residual[2] = se2.wrap_angle(residual[2])
        return float(residual @ self.information @ residual)


def optimize_anchored(graph: PoseGraph, initial: FloatArray, priors: Sequence[PosePrior]) -> FloatArray:
    """Optimize a pose graph, all of whose edges count, with priors; returns poses (N, 3) in the frame of the priors.

    The poses to start from, shape (N, 3), are in this frame, too. Priors fix the pose of each connected component.
    """
    # A prior is an edge from the origin of its frame, one more variable, which is held.
    edges, count = graph.arrays(), len(graph)
    measured = np.array([prior.pose for prior in priors]).reshape(-1, 3)
    turn = se2.adjoint(measured * (0.0, 0.0, 1.0))
    information = turn.swapaxes(1, 2) @ np.array([prior.information for prior in priors]).reshape(-1, 3, 3) @ turn
    anchored = EdgeArrays(
        i=np.append(edges.i, np.full(len(priors), count)),
        j=np.append(edges.j, [prior.variable for prior in priors]).astype(np.int64),
        T_i_j=np.concatenate((edges.T_i_j, measured)),
        information=np.concatenate((edges.information, information)),
        robust=np.zeros(len(edges.i) + len(priors), bool),
    )
    poses = np.concatenate((initial, se2.IDENTITY[None]))
    return minimize(SE2, anchored, poses, np.arange(count + 1) == count)[0][:count]
