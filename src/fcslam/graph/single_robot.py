"""The graph of one robot alone: its odometry and its own loop closures, many of which may be false."""

import numpy as np

from fcslam.graph.consistency import Closures, count_supporting_closures
from fcslam.graph.initialization import initialize, initialize_robust
from fcslam.graph.optimizer import Solution, optimize_gnc, refine_inliers
from fcslam.graph.pose_graph import PoseGraph
from fcslam.graph.trajectory import Trajectory, build_trajectory
from fcslam.records import FloatArray

_UNMEASURED_VARIANCE = 1e6
"""Variance of a step that no odometry measured, m^2 and rad^2."""


def solve_single_robot(graph: PoseGraph) -> Solution:
    """Optimize the graph of one robot robustly; its variables are in the order of its path.

    Returns the first of three solutions in which every closure holds, or the cheapest. The value of the truncated loss,
    which has many minima, ranks them:

    - Odometry decides which closures are inliers. Correct while odometry has drifted less than closures are uncertain.
    - Graduated non-convexity with every closure, from odometry. Correct while false closures are few, or small.
    - Graduated non-convexity with the closures that have supporting closures
      (``fcslam.graph.consistency.count_supporting_closures``), whose solution then decides which of all closures
      are inliers. Correct where false closures are isolated, however many and however far they reach.

    Args:
        graph: N variables and E edges of one robot.

    Returns:
        Poses (N, P) in the frame of the first variable, and weights (E,).
    """
    robust = graph.arrays().robust
    odometry = initialize(graph, (~robust).astype(float))
    by_odometry = refine_inliers(graph, odometry, ~robust)
    if by_odometry.weights.all():
        return by_odometry
    supported = ~robust
    edges = graph.arrays()
    closures = Closures(edges.i[robust], edges.j[robust], edges.T_i_j[robust], edges.information[robust])
    path = robot_trajectory(graph, odometry)
    supported[robust] = count_supporting_closures(path, path, closures) > 0
    supported_graph = graph.restricted(graph.poses(), supported)
    first = optimize_gnc(supported_graph, initialize_robust(supported_graph))
    weights = np.zeros(len(robust))
    weights[supported] = first.weights
    solutions = (by_odometry, refine_inliers(graph, first.poses, weights), optimize_gnc(graph, odometry))
    return min(solutions, key=lambda solution: solution.cost)


def robot_trajectory(graph: PoseGraph, poses: FloatArray) -> Trajectory:
    """The trajectory of one robot through ``poses`` (N, P), with the covariance of the odometry of its graph."""
    edges = graph.arrays()
    covariance = np.tile(_UNMEASURED_VARIANCE * np.eye(graph.group.freedom), (max(0, len(graph) - 1), 1, 1))
    steps = ~edges.robust & (edges.j == edges.i + 1)
    covariance[edges.i[steps]] = np.linalg.inv(edges.information[steps])
    return build_trajectory(poses, covariance)
