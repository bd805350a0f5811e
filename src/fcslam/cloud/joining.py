"""When do two robots share a map? On the dominant cluster of closures that agree with one another, and not before."""

import numpy as np

from fcslam.cloud.joint_graph import JointGraph
from fcslam.cloud.ledger import Entry
from fcslam.geometry import se2
from fcslam.geometry.alignment import two_point_alignment
from fcslam.graph.consistency import (
    Closures,
    ClusterVerdict,
    ConsistencySettings,
    dominant_cluster,
    pairwise_consistency,
)
from fcslam.records import FloatArray, KeyscanId

DIRECTION_M = 1.0
"""Two points as far apart as this, each known to a few centimetres, give a direction."""


def oriented(entry: Entry, robot_a: str) -> tuple[KeyscanId, KeyscanId, FloatArray, FloatArray]:
    """Keyscan of ``robot_a``, keyscan of the other robot, T_a_b, information: the closure seen from one side."""
    closure = entry.closure
    if closure.i.robot == robot_a:
        return closure.i, closure.j, closure.T_i_j, closure.information
    adjoint = se2.adjoint(closure.T_i_j)
    # The tangent space moves from j to i: v_i = -Ad(T_i_j) v_j.
    back = np.linalg.inv(adjoint)
    return closure.j, closure.i, se2.inverse(closure.T_i_j), back.T @ closure.information @ back


def judge(
    entries: list[Entry], robots: tuple[str, str], graph: JointGraph, settings: ConsistencySettings
) -> ClusterVerdict:
    """The dominant cluster among the verified closures of two robots."""
    a, b = robots
    sides = [oriented(entry, a) for entry in entries]
    trajectory_a, trajectory_b = graph.trajectory(a), graph.trajectory(b)
    closures = Closures(
        i=np.array([i.number for i, _, _, _ in sides]),
        j=np.array([j.number for _, j, _, _ in sides]),
        T_i_j=np.array([T for _, _, T, _ in sides]),
        information=np.array([information for _, _, _, information in sides]),
    )
    consistent = pairwise_consistency(trajectory_a, trajectory_b, closures, settings)
    informative = [entry.closure.informative for entry in entries]
    places = np.stack((trajectory_a[closures.i, :2], trajectory_b[closures.j, :2]), axis=1)
    return dominant_cluster(consistent, places, informative, settings)


def first_estimate(members: list[Entry], robots: tuple[str, str], graph: JointGraph) -> FloatArray:
    """T_a_b of the two robots' maps from the two matched places that lie farthest apart, eqs. (5)-(6).

    Places too near to each other to tell a direction leave it to the first closure alone.
    """
    a, _ = robots
    sides = [oriented(entry, a) for entry in members]
    in_a = np.array([se2.compose(graph.pose(i), T)[:2] for i, _, T, _ in sides])
    in_b = np.array([graph.pose(j)[:2] for _, j, _, _ in sides])
    distance = np.hypot(*np.moveaxis(in_b[:, None] - in_b[None], -1, 0))
    k, m = np.unravel_index(int(np.argmax(distance)), distance.shape)
    if distance[k, m] < DIRECTION_M:
        i, j, T_i_j, _ = sides[0]
        return se2.compose(se2.compose(graph.pose(i), T_i_j), se2.inverse(graph.pose(j)))
    return two_point_alignment(in_a[[k, m]], in_b[[k, m]])
