"""Pose graphs as g2o text (2D).

    VERTEX_SE2 id x y theta
    EDGE_SE2 i j x y theta xx xy xt yy yt tt

The format does not mark closures: an edge between two consecutive ids is odometry, all others are closures.
"""

from collections.abc import Sequence

import numpy as np

from fcslam.graph.pose_graph import PoseGraph


def g2o_text(graph: PoseGraph, ids: Sequence[int]) -> str:
    """A graph as g2o text, variables by ascending id; reading it again gives the same numbers, bit by bit.

    Args:
        graph: the pose graph.
        ids: id of each variable.
    """
    if len(ids) != len(graph) or len(set(ids)) != len(ids):
        raise ValueError(f"{len(graph)} variables need as many different ids, not {len(ids)}")
    lines = [f"VERTEX_SE2 {name} {_text(pose)}" for name, pose in sorted(zip(ids, graph.poses().tolist(), strict=True))]
    edges, (row, column) = graph.given(), np.triu_indices(3)
    numbers = np.hstack((edges.T_i_j, edges.information[:, row, column])).tolist()
    for i, j, values in zip(edges.i.tolist(), edges.j.tolist(), numbers, strict=True):
        lines.append(f"EDGE_SE2 {ids[i]} {ids[j]} {_text(values)}")
    return "\n".join(lines) + "\n"


def _text(numbers: list[float]) -> str:
    return " ".join(map(repr, numbers))
