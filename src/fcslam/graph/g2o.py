"""Pose graphs as g2o text.

    VERTEX_SE2 id x y theta                        VERTEX_SE3:QUAT id x y z qx qy qz qw
    EDGE_SE2 i j x y theta xx xy xt yy yt tt       EDGE_SE3:QUAT i j x y z qx qy qz qw, and 21 numbers of information

In space, g2o measures rotations by the vector of their quaternion, half the angle of ours.

The format does not mark closures: an edge between two consecutive ids is odometry, all others are closures.
"""

from collections.abc import Sequence

import numpy as np

from fcslam.geometry.groups import SE2
from fcslam.graph.pose_graph import PoseGraph


def g2o_text(graph: PoseGraph, ids: Sequence[int]) -> str:
    """A graph as g2o text, variables by ascending id; reading it again gives the same numbers, bit by bit.

    Args:
        graph: the pose graph.
        ids: id of each variable.
    """
    if len(ids) != len(graph) or len(set(ids)) != len(ids):
        raise ValueError(f"{len(graph)} variables need as many different ids, not {len(ids)}")
    kind, half = ("SE2", 1.0) if graph.group is SE2 else ("SE3:QUAT", 2.0)
    poses = sorted(zip(ids, graph.poses().tolist(), strict=True))
    lines = [f"VERTEX_{kind} {name} {_text(pose)}" for name, pose in poses]
    edges, (row, column) = graph.given(), np.triu_indices(graph.group.freedom)
    unit = graph.group.sigmas(1.0, half)
    information = edges.information * np.outer(unit, unit)
    numbers = np.hstack((edges.T_i_j, information[:, row, column])).tolist()
    for i, j, values in zip(edges.i.tolist(), edges.j.tolist(), numbers, strict=True):
        lines.append(f"EDGE_{kind} {ids[i]} {ids[j]} {_text(values)}")
    return "\n".join(lines) + "\n"


def _text(numbers: list[float]) -> str:
    return " ".join(map(repr, numbers))
