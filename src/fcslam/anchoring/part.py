"""One map of a result: its robots, and their graph alone."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from fcslam.cloud.result import FleetResult, MappedRobot
from fcslam.geometry import se2
from fcslam.graph.optimizer import PosePrior, optimize_anchored
from fcslam.graph.pose_graph import PoseGraph
from fcslam.records import FloatArray, frozen

LEAST_SIGMA_M: Final = 0.02
"""Least standard deviation of a position outside of the map, by a survey or a receiver, whatever they say."""
ROUNDS: Final = 4
"""Such positions are linearized, and poses are solved, this often."""
_HEADING_INFORMATION: Final = 1e-6


@dataclass(frozen=True, slots=True, eq=False)
class MapPart:
    """The robots of one map, and the graph of these alone."""

    robots: tuple[MappedRobot, ...]
    """With the variables of this graph."""
    graph: PoseGraph

    def at(self, poses: FloatArray) -> "MapPart":
        """This part with other poses of the variables, shape (N, 3), metres and radians."""
        robots = tuple(replace(robot, T_map_base=frozen(poses[robot.variables])) for robot in self.robots)
        return MapPart(robots, PoseGraph.restored(poses, self.graph.given()))


def part_of(result: FleetResult, k: int) -> MapPart:
    """Map ``k`` of a result."""
    members = [robot for robot in result.robots if robot.map_index == k]
    rows = _variables(members)
    every, mine = np.ones(result.graph.edge_count, bool), np.isin(np.arange(len(result.graph)), rows)
    robots = tuple(
        replace(robot, variables=frozen(np.searchsorted(rows, robot.variables), np.int64)) for robot in members
    )
    return MapPart(robots, result.graph.restricted(result.graph.poses(), every, mine))


def with_part(result: FleetResult, k: int, part: MapPart) -> FleetResult:
    """The result with map ``k`` as it is in ``part``."""
    before = {robot.robot: robot for robot in result.robots}
    after = {robot.robot: replace(robot, variables=before[robot.robot].variables) for robot in part.robots}
    rows = _variables(list(after.values()))
    poses = result.graph.poses()
    poses[rows] = part.graph.poses()
    edges, own = result.graph.given(), part.graph.given()
    inside = np.isin(edges.i, rows) & np.isin(edges.j, rows)
    T_i_j, information = edges.T_i_j.copy(), edges.information.copy()
    T_i_j[inside], information[inside] = own.T_i_j, own.information
    graph = PoseGraph.restored(poses, replace(edges, T_i_j=T_i_j, information=information))
    first = part.robots[0]
    T = se2.compose(first.T_map_base[0], se2.inverse(before[first.robot].T_map_base[0]))
    regions = tuple(
        replace(region, polygon=frozen(se2.transform(T, region.polygon))) if region.map_index == k else region
        for region in result.regions
    )
    robots = tuple(after.get(robot.robot, robot) for robot in result.robots)
    return replace(result, robots=robots, graph=graph, regions=regions)


@dataclass(frozen=True, slots=True, eq=False)
class Positions:
    """Positions, outside of the map, of points that robots carry or see."""

    variables: NDArray[np.int64]
    """Variables of the keyscans, shape (N,)."""
    arms: FloatArray
    """The points in the base of the keyscans, shape (N, 2)."""
    xy: FloatArray
    """Shape (N, 2), metres."""
    sigma_m: FloatArray
    """Shape (N,)."""

    def points(self, poses: FloatArray) -> FloatArray:
        """Where the points are by poses of the variables, shape (N, 2)."""
        flat = np.column_stack((self.arms, np.zeros(len(self.arms))))
        return np.asarray(se2.compose(poses[self.variables], flat)[:, :2])

    def solved(self, graph: PoseGraph, poses: FloatArray, counts: NDArray[np.bool_] | None = None) -> FloatArray:
        """The poses that the graph and the positions give, linearized at ``poses``; None: all of them count."""
        levers = self.points(poses) - poses[self.variables, :2]
        jacobians = np.zeros((len(levers), 2, 3))
        jacobians[:, :, :2], jacobians[:, :, 2] = np.eye(2), np.column_stack((-levers[:, 1], levers[:, 0]))
        information = jacobians.swapaxes(1, 2) @ jacobians / self.sigma_m[:, None, None] ** 2
        information[:, 2, 2] += _HEADING_INFORMATION  # the solver needs some
        measured = np.column_stack((self.xy - levers, poses[self.variables, 2]))
        rows = range(len(levers)) if counts is None else np.flatnonzero(counts).tolist()
        priors = [PosePrior(int(self.variables[row]), measured[row], information[row]) for row in rows]
        return optimize_anchored(graph, poses, priors)


def _variables(robots: Sequence[MappedRobot]) -> FloatArray:
    return np.sort(np.concatenate([robot.variables for robot in robots]))
