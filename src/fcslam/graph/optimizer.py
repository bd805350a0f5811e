"""Optimal poses of a pose graph: Levenberg-Marquardt (GTSAM), and graduated non-convexity against false closures.

Gauge: each connected component keeps the initial pose of its first variable.
"""

from dataclasses import dataclass
from typing import Any

import gtsam
import numpy as np
from numpy.typing import ArrayLike, NDArray

from fcslam.geometry import se2
from fcslam.graph.factors import FactorCache, Loss
from fcslam.graph.pose_graph import CHI2_LIMIT, PoseGraph, anchors
from fcslam.records import FloatArray, frozen

_TOLERANCE = 1e-6
"""Relative and absolute change of the cost at which Levenberg-Marquardt ends."""
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
    """Shape (N, 3), metres and radians."""
    weights: FloatArray
    """Shape (E,), in [0, 1]; 1 for odometry."""
    iterations: int
    """Solver iterations of all steps together."""
    cost: float
    """Half the sum of the edges' losses at the poses."""


def optimize(
    graph: PoseGraph,
    initial: ArrayLike | None = None,
    *,
    loss: Loss = Loss.SQUARED,
    kept: ArrayLike | None = None,
    factors: FactorCache | None = None,
    solved: NDArray[np.bool_] | None = None,
) -> Solution:
    """Optimize a pose graph by Levenberg-Marquardt.

    Args:
        graph: N variables and E edges.
        initial: poses to start from, shape (N, 3), metres and radians; None: the graph's own.
        loss: loss of the closures.
        kept: closures that count, shape (E,); None: all.
        factors: a cache that makes repeated solves of a growing graph cheaper.
        solved: variables of the connected components to solve, shape (N,); others stay, and do not count in the cost.
            None: all.

    Returns:
        Poses (N, 3) and weights (E,).
    """
    start, cache = _start(graph, initial), _cache(graph, factors)
    if not graph.edge_count:
        return _solution(graph, start, start, np.ones(0), 0, 0.0)
    robust = graph.arrays().robust
    counts = np.ones(int(robust.sum()), dtype=bool) if kept is None else np.asarray(kept, dtype=bool)[robust]
    problem, values = cache.robust(loss, counts, start, solved), cache.values(start, solved)
    result, iterations = _levenberg_marquardt(problem, values, _MAXIMUM_ITERATIONS)
    poses = start.copy()
    cache.read(result, poses, solved)
    cache.complete(poses)
    weights = counts * loss.weights(graph.chi2(poses)[robust])
    return _solution(graph, start, poses, weights, iterations, problem.error(result))


def optimize_gnc(
    graph: PoseGraph,
    initial: ArrayLike | None = None,
    *,
    factors: FactorCache | None = None,
) -> Solution:
    """Optimize under the truncated squared loss on closures: each ends at weight 1 (inlier) or 0 (outlier).

    Graduated non-convexity (Yang et al., RA-L 2020, truncated least squares, eqs. 12-14); odometry always counts.

    The steps run here, around GTSAM's solver, and not in ``gtsam.GncLMOptimizer``, which starts every step again from
    the initial poses and solves it to convergence. One warm iteration per step decides as well in a tenth of the time
    (``benchmarks/results/graph.md``, m3500 with 100 random false loops). Neither is sure to find the best set: the
    drift of the odometry may favour a false loop.

    ``initial`` is odometry or better. Arguments and result as of ``optimize``.
    """
    start, cache = _start(graph, initial), _cache(graph, factors)
    robust = graph.arrays().robust
    if not graph.edge_count:
        return _solution(graph, start, start, np.ones(0), 0, 0.0)
    steps = _Steps(cache, start)
    steps.solve(np.ones(int(robust.sum())), _FIRST_ITERATIONS)
    _graduate(steps)
    weights = _alternate(steps, (steps.chi2() <= CHI2_LIMIT).astype(np.float64))
    return _with_truncated_cost(graph, start, steps, weights)


def refine_inliers(
    graph: PoseGraph,
    initial: ArrayLike | None,
    weights: ArrayLike,
    *,
    factors: FactorCache | None = None,
) -> Solution:
    """Alternate solving and deciding every closure by its residual, until no decision changes.

    The last part of ``optimize_gnc``, from closures that are trusted already: for graphs most of whose closures are
    false, where optimizing with all of them gives no useful start.

    ``weights`` (E,): edges above one half are trusted at the start. Other arguments and result as of ``optimize``.
    """
    start, cache = _start(graph, initial), _cache(graph, factors)
    trusted = np.asarray(weights, dtype=np.float64)
    if trusted.shape != (graph.edge_count,):
        raise ValueError(f"weights must be of shape ({graph.edge_count},), not {trusted.shape}")
    if not graph.edge_count:
        return _solution(graph, start, start, np.ones(0), 0, 0.0)
    robust = graph.arrays().robust
    steps = _Steps(cache, start)
    decided = _alternate(steps, (trusted[robust] > INLIER_WEIGHT).astype(np.float64))
    return _with_truncated_cost(graph, start, steps, decided)


class _Steps:
    def __init__(self, cache: FactorCache, poses: FloatArray) -> None:
        self.cache, self.poses, self.iterations = cache, poses.copy(), 0
        self._values = cache.values(poses)
        self._robust = np.flatnonzero(cache.graph.arrays().robust)
        self._optimal_for: FloatArray | None = None
        """The weights for which the poses are optimal."""

    def solve(self, weights: FloatArray, iterations: int) -> None:
        if self._optimal_for is not None and np.array_equal(weights, self._optimal_for):
            return
        problem = self.cache.squared(weights, self.poses)
        self._values, used = _levenberg_marquardt(problem, self._values, iterations)
        self.cache.read(self._values, self.poses)
        self.iterations += used
        self._optimal_for = weights if used < iterations else None

    def chi2(self) -> FloatArray:
        """Squared Mahalanobis lengths of the closures' residuals, shape (K,)."""
        return self.cache.graph.chi2(self.poses, self._robust)


def _graduate(steps: _Steps) -> None:
    chi2 = steps.chi2()
    largest = chi2.max(initial=0.0)
    if largest <= CHI2_LIMIT:
        return
    mu = CHI2_LIMIT / (2.0 * largest - CHI2_LIMIT)
    for _ in range(_MAXIMUM_ITERATIONS):  # closures that are then still undecided are decided by their residuals
        weights = _truncated_weights(chi2, mu)
        if np.all((weights < _BINARY) | (weights > 1.0 - _BINARY)):
            return
        steps.solve(weights, iterations=1)
        chi2 = steps.chi2()
        mu *= _CONTROL_STEP


def _alternate(steps: _Steps, weights: FloatArray) -> FloatArray:
    """Alternate solve and decision until no decision changes, each of which lowers the truncated loss."""
    for _ in range(_REFINEMENT_ROUNDS):
        steps.solve(weights, _MAXIMUM_ITERATIONS)
        decided = (steps.chi2() <= CHI2_LIMIT).astype(np.float64)
        if np.array_equal(decided, weights):
            return weights
        weights = decided
    steps.solve(weights, _MAXIMUM_ITERATIONS)
    return weights


def _with_truncated_cost(graph: PoseGraph, start: FloatArray, steps: _Steps, weights: FloatArray) -> Solution:
    poses, robust = steps.poses, graph.arrays().robust
    steps.cache.complete(poses)
    cost = _truncated(graph.chi2(poses), robust)
    return _solution(graph, start, poses, weights, steps.iterations, cost)


def _truncated_weights(chi2: FloatArray, mu: float) -> FloatArray:
    """Weights of the surrogate of the truncated squared loss at ``mu`` (Yang et al. 2020, eq. 14)."""
    with np.errstate(divide="ignore"):
        between = np.sqrt(CHI2_LIMIT * mu * (mu + 1.0) / chi2) - mu
    return np.clip(between, 0.0, 1.0)


def _truncated(chi2: FloatArray, robust: ArrayLike) -> float:
    return 0.5 * float(np.where(robust, np.minimum(chi2, CHI2_LIMIT), chi2).sum())


def _levenberg_marquardt(problem: Any, values: Any, iterations: int) -> tuple[Any, int]:
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setMaxIterations(iterations)
    parameters.setRelativeErrorTol(_TOLERANCE)
    parameters.setAbsoluteErrorTol(_TOLERANCE)
    solver = gtsam.LevenbergMarquardtOptimizer(problem, values, parameters)
    result = solver.optimize()
    return result, int(solver.iterations())


def _start(graph: PoseGraph, initial: ArrayLike | None) -> FloatArray:
    poses = graph.poses() if initial is None else np.array(initial, dtype=np.float64)
    if poses.shape != (len(graph), 3) or not np.isfinite(poses).all():
        raise ValueError(f"initial poses must be finite and of shape ({len(graph)}, 3), not {poses.shape}")
    return poses


def _cache(graph: PoseGraph, factors: FactorCache | None) -> FactorCache:
    if factors is not None and factors.graph is not graph:
        raise ValueError("the factors belong to another pose graph")
    return factors or FactorCache(graph)


def _solution(
    graph: PoseGraph, start: FloatArray, poses: FloatArray, closure_weights: FloatArray, iterations: int, cost: float
) -> Solution:
    """The solution, with each connected component moved so that its first variable is at its initial pose."""
    weights = np.ones(graph.edge_count)
    weights[graph.arrays().robust] = closure_weights
    components = graph.components(weights > 0.0)
    first = anchors(components)
    moved = se2.compose(se2.compose(start[first], se2.inverse(poses[first]))[components], poses)
    moved[first] = start[first]
    return Solution(frozen(moved), frozen(weights), iterations, cost)
