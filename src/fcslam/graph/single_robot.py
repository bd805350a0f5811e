"""The graph of one robot alone: its odometry and its own loop closures, many of which may be false."""

import numpy as np

from fcslam.graph.chains import Chains, find_chains
from fcslam.graph.consistency import Closures, count_supporting_closures
from fcslam.graph.factors import FactorCache
from fcslam.graph.initialization import initialize, initialize_robust
from fcslam.graph.optimizer import Solution, optimize_gnc, refine_inliers
from fcslam.graph.pose_graph import PoseGraph
from fcslam.graph.trajectory import Trajectory, build_trajectory
from fcslam.records import FloatArray

_UNMEASURED_VARIANCE = 1e6
"""Variance of a step that no odometry measured, m^2 and rad^2."""


def solve_single_robot(graph: PoseGraph, factors: FactorCache | None = None) -> Solution:
    """Optimize the graph of one robot robustly; its variables are in the order of its path.

    Returns the cheapest of three solutions; the value of the truncated loss, which has many minima, ranks them:

    - Odometry decides which closures are inliers. Correct while odometry has drifted less than closures are uncertain.
    - Graduated non-convexity with every closure, from odometry. Correct while false closures are few, or small.
    - Graduated non-convexity with the closures that have supporting closures
      (``fcslam.graph.consistency.count_supporting_closures``), whose solution then decides which of all closures
      are inliers. Correct where false closures are isolated, however many and however far they reach.

    Args:
        graph: N variables and E edges of one robot.
        factors: those of ``graph``, where they are built already.

    Returns:
        Poses (N, 3) in the frame of the first variable, and weights (E,).
    """
    robust, factors = graph.arrays().robust, factors or FactorCache(graph, find_chains(graph))
    odometry = initialize(graph, (~robust).astype(float))
    by_odometry = refine_inliers(graph, odometry, ~robust, factors=factors)
    if not robust.any():
        return by_odometry
    supported = ~robust
    edges = graph.arrays()
    closures = Closures(edges.i[robust], edges.j[robust], edges.T_i_j[robust], edges.information[robust])
    path = robot_trajectory(graph, odometry)
    supported[robust] = count_supporting_closures(path, path, closures) > 0
    supported_graph = graph.restricted(graph.poses(), supported)
    first = optimize_gnc(
        supported_graph,
        _robust_start(supported_graph, factors.chains),
        factors=factors.restricted(supported_graph, supported[robust]),
    )
    weights = np.zeros(len(robust))
    weights[supported] = first.weights
    solutions = (
        by_odometry,
        refine_inliers(graph, first.poses, weights, factors=factors),
        optimize_gnc(graph, odometry, factors=factors),
    )
    return min(solutions, key=lambda solution: solution.cost)


def _robust_start(graph: PoseGraph, chains: Chains | None) -> FloatArray:
    """Initial poses (N, 3) that false closures hardly bend; those inside of chains follow from the ends."""
    if chains is None:
        return initialize_robust(graph)
    poses = graph.poses()
    poses[chains.kept] = initialize_robust(chains.contract(graph))
    chains.expand(poses)
    return poses


def robot_trajectory(graph: PoseGraph, poses: FloatArray) -> Trajectory:
    """The trajectory of one robot through ``poses`` (N, 3), with the covariance of the odometry of its graph."""
    edges = graph.arrays()
    covariance = np.tile(_UNMEASURED_VARIANCE * np.eye(3), (max(0, len(graph) - 1), 1, 1))
    steps = ~edges.robust & (edges.j == edges.i + 1)
    covariance[edges.i[steps]] = np.linalg.inv(edges.information[steps])
    return build_trajectory(poses, covariance)
