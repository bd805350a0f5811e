"""Relations as a pose graph. Its optimum gives relative poses of stamps that no single relation connects."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import shortest_path

from fcslam.geometry import se2
from fcslam.graph.initialization import initialize_robust
from fcslam.graph.optimizer import optimize_gnc
from fcslam.graph.pose_graph import Edge, PoseGraph
from fcslam.metrics.relations import Relations
from fcslam.records import FloatArray, frozen

SIGMA_M, SIGMA_DEG = 0.05, 1.0
"""Assumed standard deviation of a manual relation, the same for all. It decides which relations contradict each other;
for consistent relations, it cancels out."""


@dataclass(frozen=True, slots=True)
class RelationGraph:
    """The optimised pose graph of a set of relations."""

    stamps: FloatArray
    """Stamps of all relations, ascending, shape (M,), seconds."""
    T_component_base: FloatArray
    """Optimised poses, shape (M, 3); each component has its own coordinate frame."""
    components: NDArray[np.int64]
    """Connected component of each stamp by inlier relations, shape (M,)."""
    relations: Relations
    """The relations of the graph; relations between equal stamps are dropped."""
    ends: NDArray[np.int64]
    """Numbers of the stamps that each relation connects, shape (R, 2)."""
    holds: NDArray[np.bool_]
    """Inliers of the robust optimisation, shape (R,)."""
    residual_m: FloatArray
    """Translation residual of each relation, shape (R,); NaN across components."""
    residual_deg: FloatArray
    """Rotation residual of each relation, shape (R,); NaN across components."""

    @property
    def component_sizes(self) -> NDArray[np.int64]:
        """Number of stamps in each component, the largest first, shape (C,)."""
        return np.sort(np.bincount(self.components))[::-1]

    def chain_lengths(self, pairs: NDArray[np.int64]) -> FloatArray:
        """Length of the shortest chain of relations between stamps with numbers (K, 2): shape (K,), inf without one."""
        joined = self.ends[self.holds]
        links = coo_array((np.ones(len(joined)), tuple(joined.T)), shape=(len(self.stamps), len(self.stamps)))
        sources, row = np.unique(pairs[:, 0], return_inverse=True)
        if not len(sources):
            return np.empty(0)
        lengths = shortest_path(links.tocsr(), directed=False, unweighted=True, indices=sources)
        return np.asarray(lengths[row, pairs[:, 1]])


def build_relation_graph(relations: Relations) -> RelationGraph:
    """Optimise ``relations``, any of which may be false, by graduated non-convexity."""
    useful = relations.where(relations.stamps[:, 0] != relations.stamps[:, 1])
    stamps, numbers = np.unique(useful.stamps, return_inverse=True)
    ends = numbers.reshape(-1, 2)
    information = np.diag([SIGMA_M**-2, SIGMA_M**-2, np.radians(SIGMA_DEG) ** -2])
    edges = [
        Edge(i, j, T_1_2, information, robust=True) for (i, j), T_1_2 in zip(ends.tolist(), useful.T_1_2, strict=True)
    ]
    graph = PoseGraph(np.zeros((len(stamps), 3)), edges)
    solution = optimize_gnc(graph, initialize_robust(graph))
    holds = solution.weights > 0.5
    components = graph.components(holds)
    first, second = ends.T
    residual = se2.between(useful.T_1_2, se2.between(solution.poses[first], solution.poses[second]))
    residual[components[first] != components[second]] = np.nan
    return RelationGraph(
        frozen(stamps),
        solution.poses,
        frozen(components, np.int64),
        useful,
        frozen(ends, np.int64),
        frozen(holds, np.bool_),
        frozen(np.hypot(residual[:, 0], residual[:, 1])),
        frozen(np.degrees(np.abs(residual[:, 2]))),
    )
