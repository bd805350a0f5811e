"""One robot's own solution: its odometry and the closures within its path, of which many may be false."""

import numpy as np

from fcslam.graph.consistency import Closures, ConsistencySettings, witnesses
from fcslam.graph.initialization import initialize, initialize_robust
from fcslam.graph.optimizer import GncSettings, Solution, optimize_gnc, settle
from fcslam.graph.pose_graph import PoseGraph
from fcslam.graph.trajectory import DriftSettings, Trajectory, trajectory
from fcslam.records import FloatArray

_UNMEASURED = 1e6
"""Variance of a step without odometry, m^2 and rad^2."""


def solve_alone(graph: PoseGraph, consistency: ConsistencySettings, gnc: GncSettings | None = None) -> Solution:
    """Robust poses of one robot's graph, its variables in the order of its path: the cheapest of three solutions.

    - All closures decided by the odometry: right while it has drifted less than closures are uncertain.
    - Graduated non-convexity with every closure, from the odometry: right while false closures are few, or small.
    - The same with those closures only that have witnesses (:func:`fcslam.graph.consistency.witnesses`), then all
      decided by that solution: right where false closures stand alone, however many and however far they reach.

    The truncated loss has many minima; its value ranks them.
    """
    robust = graph.arrays().robust
    odometry = initialize(graph, (~robust).astype(float))
    by_odometry = settle(graph, odometry, ~robust, settings=gnc)
    if not robust.any():
        return by_odometry
    borne_out = ~robust
    edges = graph.arrays()
    closures = Closures(edges.i[robust], edges.j[robust], edges.T_i_j[robust], edges.information[robust])
    path = path_of(graph, odometry, consistency)
    borne_out[robust] = witnesses(path, path, closures, consistency) > 0
    witnessed = PoseGraph(graph.poses(), [edge for edge, kept in zip(graph.edges, borne_out, strict=True) if kept])
    first = optimize_gnc(witnessed, initialize_robust(witnessed), settings=gnc)
    weights = np.zeros(len(robust))
    weights[borne_out] = first.weights
    solutions = (
        by_odometry,
        settle(graph, first.poses, weights, settings=gnc),
        optimize_gnc(graph, odometry, settings=gnc),
    )
    return min(solutions, key=lambda solution: solution.stats.final_cost)


def path_of(graph: PoseGraph, poses: FloatArray, settings: DriftSettings) -> Trajectory:
    """``poses`` (N, 3) of one robot's variables as a trajectory that drifts as the graph's odometry says."""
    edges = graph.arrays()
    covariance = np.tile(_UNMEASURED * np.eye(3), (max(0, len(graph) - 1), 1, 1))
    steps = ~edges.robust & (edges.j == edges.i + 1)
    covariance[edges.i[steps]] = np.linalg.inv(edges.information[steps])
    return trajectory(poses, settings, covariance)
