"""The cloud's closures in the terms of ``graph/cluster.py``, which decides whether they join two maps."""

from collections.abc import Callable, Sequence

import numpy as np

from fcslam.cloud.closure_log import ClosureEntry
from fcslam.cloud.joint_graph import JointGraph
from fcslam.graph import cluster
from fcslam.graph.cluster import ClusterDecision
from fcslam.graph.consistency import Closures
from fcslam.graph.evidence import ConsistencySettings, MapFit
from fcslam.graph.trajectory import Trajectory

ExamineSessions = Callable[[tuple[str, str], Trajectory, Trajectory, Closures], MapFit | None]
"""As ``MapComparison.fit``."""

CONSISTENCY = "fleet.consistency"
"""Section of the configuration that holds the rule for joining maps."""


def decide_join(
    entries: Sequence[ClosureEntry],
    robots: tuple[str, str],
    graph: JointGraph,
    settings: ConsistencySettings,
    examine: ExamineSessions,
) -> ClusterDecision:
    """The dominant cluster among the closures of two robots, by the current estimate of their trajectories."""
    a, b = (graph.path(robot) for robot in robots)
    informative, closures = [entry.closure.informative for entry in entries], _closures(entries, robots[0])
    return cluster.decide_cluster(
        a, b, closures, informative, settings, lambda members: examine(robots, a, b, closures.select(members))
    )


def _closures(entries: Sequence[ClosureEntry], robot_a: str) -> Closures:
    """The closures as measurements from robot a to the other."""
    found = [entry.closure for entry in entries]
    tags = [closure.tag for closure in found]
    numbers = {tag: number for number, tag in enumerate(dict.fromkeys([None, *tags]))}
    closures = Closures(
        np.array([closure.i.number for closure in found], dtype=np.int64),
        np.array([closure.j.number for closure in found], dtype=np.int64),
        np.array([closure.T_i_j for closure in found]).reshape(-1, 3),
        np.array([closure.information for closure in found]).reshape(-1, 3, 3),
        np.array([numbers[tag] for tag in tags], dtype=np.int64),
    )
    return closures.reversed(np.array([closure.i.robot != robot_a for closure in found], dtype=bool))
