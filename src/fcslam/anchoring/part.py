"""One map of a result: its robots, and their graph alone."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from fcslam.cloud.result import FleetResult, MappedRobot
from fcslam.geometry import se2
from fcslam.graph.optimizer import PosePrior
from fcslam.graph.pose_graph import PoseGraph
from fcslam.records import FloatArray, frozen

LEAST_SIGMA_M: Final = 0.02
"""Least standard deviation of a position outside of the map, by a survey or a receiver, whatever they say."""
ROUNDS: Final = 4
"""Finding what such positions say about the poses, and solving, alternate this often."""
_HEADING_INFORMATION: Final = 1e-6


@dataclass(frozen=True, slots=True, eq=False)
class MapPart:
    """The robots of one map, and the graph of these alone."""

    robots: tuple[MappedRobot, ...]
    """With the variables of this graph."""
    graph: PoseGraph

    def at(self, poses: FloatArray) -> "MapPart":
        """The same with other poses of the variables, shape (N, 3), metres and radians."""
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
    T_after_before = {
        name: se2.compose(robot.T_map_base[-1], se2.inverse(before[name].T_map_base[-1]))
        for name, robot in after.items()
    }
    corrections = tuple(
        replace(c, T_map_odom=frozen(se2.compose(T_after_before[c.robot], c.T_map_odom))) if c.robot in after else c
        for c in result.corrections
    )
    first = part.robots[0]
    T = se2.compose(first.T_map_base[0], se2.inverse(before[first.robot].T_map_base[0]))
    regions = tuple(
        replace(region, polygon=frozen(se2.transform(T, region.polygon))) if region.map_index == k else region
        for region in result.regions
    )
    robots = tuple(after.get(robot.robot, robot) for robot in result.robots)
    return replace(result, robots=robots, corrections=corrections, graph=graph, regions=regions)


def position_prior(variable: int, xy: FloatArray, heading_rad: float, information: float) -> PosePrior:
    """A measured position (2,) of a variable; the solver needs some information about its heading."""
    return PosePrior(variable, np.append(xy, heading_rad), np.diag((information, information, _HEADING_INFORMATION)))


def _variables(robots: Sequence[MappedRobot]) -> FloatArray:
    return np.sort(np.concatenate([robot.variables for robot in robots]))
