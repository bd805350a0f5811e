"""The pose graph of the whole fleet: every robot's keyscans, their constraints, the closures between robots."""

from collections.abc import Collection, Container, Mapping
from dataclasses import fields

import numpy as np
from numpy.typing import NDArray

from fcslam.geometry.groups import SE2, Group
from fcslam.graph.least_squares import Loss
from fcslam.graph.optimizer import optimize
from fcslam.graph.pose_graph import Edge, EdgeArrays, PoseGraph, Rows
from fcslam.graph.trajectory import Trajectory, build_trajectory
from fcslam.records import Constraint, FloatArray, KeyscanId
from fcslam.storage.state_file import State

AGREES_SIGMAS = 3.0
"""A pose within this many standard deviations of a measurement agrees with it."""
SOLVED_SHARE = 0.05
"""Share of all closures that comes in between two solves, at least."""


class JointGraph:
    """Grows with the packets; poses of robots in different maps are each in their own map's frame."""

    def __init__(self, group: Group = SE2) -> None:
        self.group = group
        self.graph = PoseGraph(group=group)
        self._variables: dict[str, Rows[np.int64]] = {}
        self._chains: dict[str, Rows[np.float64]] = {}
        self._step_covariance: dict[str, Rows[np.float64]] = {}
        self._poses = Rows(np.zeros((0, group.size)))
        self._left_out: set[int] = set()
        self._closures = self._unsolved = 0
        """Closures in the graph, and those that came in since the last solve."""
        self._changed: set[int] = set()
        """Edges of the closures that came in since the last solve, or count since, or no longer do."""

    def variable(self, keyscan: KeyscanId) -> int:
        """Number of the keyscan's variable."""
        return int(self._variables[keyscan.robot].values[keyscan.number])

    def pose(self, keyscan: KeyscanId) -> FloatArray:
        """T_map_base (P,) of the keyscan in its robot's current map."""
        pose: FloatArray = self._poses.values[self.variable(keyscan)]
        return pose

    def trajectory(self, robot: str, numbers: NDArray[np.int64] | None = None) -> FloatArray:
        """T_map_base of the robot's keyscans, or of those with these numbers (N,), shape (N, P)."""
        variables = self._variables[robot].values
        trajectory: FloatArray = self._poses.values[variables if numbers is None else variables[numbers]]
        return trajectory

    def path(self, robot: str) -> Trajectory:
        """The robot's trajectory with the covariance of its odometry, for consistency checks."""
        return build_trajectory(self.trajectory(robot), self._step_covariance[robot].values)

    def chain(self, robot: str, first: int = 0, last: int | None = None) -> FloatArray:
        """T_odom_base (N, P) of keyscans first to last (inclusive), by the robot's motions without any closure."""
        end = None if last is None else last + 1
        return self._chains[robot].values[first:end].copy()

    def travel_since(self, robot: str) -> FloatArray:
        """Way in metres from each keyscan of the robot to its newest one by its motions, shape (N,)."""
        steps = np.diff(self._chains[robot].values, axis=0)
        travel_m = np.concatenate(([0.0], np.cumsum(self.group.shift_m(steps))))
        since_m: FloatArray = travel_m[-1] - travel_m
        return since_m

    def T_map_odom(self, robot: str, T_map_newest: FloatArray | None = None) -> FloatArray:
        """Where the robot's odometry (the chain of its motions) starts in the map, by its newest keyscan.

        ``T_map_newest`` (P,) says where that is, by default where it is estimated now.
        """
        newest = self._poses.values[self._variables[robot].values[-1]]
        T_map_base = newest if T_map_newest is None else T_map_newest
        return self.group.compose(T_map_base, self.group.inverse(self._chains[robot].values[-1]))

    def start(self, robot: str) -> None:
        """First keyscan of a robot: the origin of a map of its own."""
        self._chains[robot] = Rows(self.group.identity[None])
        self._step_covariance[robot] = Rows(np.zeros((0, self.group.freedom, self.group.freedom)))
        self._variables[robot] = Rows(np.array([self._add_variable(self.group.identity)]))

    def extend(self, constraint: Constraint) -> None:
        """A robot's motion to its next keyscan."""
        robot = constraint.robot
        previous = int(self._variables[robot].values[-1])
        variable = self._add_variable(self.group.compose(self._poses.values[previous], constraint.T_i_j))
        self._variables[robot].append(variable)
        self._step_covariance[robot].append(np.linalg.inv(constraint.information))
        self._chains[robot].append(self.group.compose(self._chains[robot].values[-1], constraint.T_i_j))
        self.graph.add_edge(Edge(previous, variable, constraint.T_i_j, constraint.information, robust=False))

    def close(self, i: KeyscanId, j: KeyscanId, T_i_j: FloatArray, information: FloatArray) -> int:
        """A closure; returns the number of its edge."""
        self._unsolved += 1
        self._closures += 1
        edge = self.graph.add_edge(Edge(self.variable(i), self.variable(j), T_i_j, information, robust=True))
        self._changed.add(edge)
        return edge

    def innovation(self, i: KeyscanId, j: KeyscanId, T_i_j: FloatArray) -> tuple[float, float]:
        """Difference of a measurement T_i_j (P,) and the estimate, in metres and radians."""
        off = self.group.between(self.group.between(self.pose(i), self.pose(j)), T_i_j)
        return float(self.group.shift_m(off)), float(self.group.turn_rad(off))

    def is_due(self, closures: int) -> bool:
        """Whether that many closures came in since the last solve, and the graph has grown noticeably.

        A solve costs as much as the graph is large: growth by a constant share keeps the cost per closure constant.
        """
        return self._unsolved >= max(closures, SOLVED_SHARE * self._closures)

    def count(self, edge: int, *, holds: bool) -> None:
        """Include the closure in the next solves, or exclude it."""
        (self._left_out.discard if holds else self._left_out.add)(edge)
        self._changed.add(edge)

    def optimize(self) -> None:
        """Quick solve (Levenberg-Marquardt with a Cauchy loss on closures) of the maps whose closures changed."""
        poses, kept, edges, changed = self._poses.values.copy(), self._kept(), self.graph.arrays(), list(self._changed)
        component = self.graph.components(kept)
        solved = np.isin(component, component[np.concatenate((edges.i[changed], edges.j[changed]))])
        poses[solved] = optimize(self.graph.restricted(poses, kept, solved), loss=Loss.CAUCHY).poses
        self.take(poses)

    def take(self, poses: FloatArray) -> None:
        """Replace the estimate by a solution, shape (N, P)."""
        self._poses.values[: len(poses)] = poses
        self._unsolved = 0
        self._changed.clear()

    def held(self, T_map_base: Mapping[str, FloatArray], left_out: Container[int | None]) -> PoseGraph:
        """These robots at poses (N, P), with the constraints that are not left out: the graph of a finished run.

        No constraint that connects one of them with another robot is kept.
        """
        kept, poses = np.zeros(len(self.graph), bool), np.zeros((len(self.graph), self.group.size))
        for robot, T_robot in T_map_base.items():
            variables = self._variables[robot].values
            poses[variables], kept[variables] = T_robot, True
        counts = np.array([number not in left_out for number in range(self.graph.edge_count)], bool)
        return self.graph.restricted(poses, counts, kept)

    def held_variables(self, robots: Collection[str]) -> dict[str, NDArray[np.int64]]:
        """Variables of each of these robots in the graph that ``held`` makes of them, in the order of its path."""
        variables = [self._variables[robot].values for robot in robots]
        kept = np.sort(np.concatenate(variables)) if variables else np.empty(0, np.int64)
        return {robot: np.searchsorted(kept, own) for robot, own in zip(robots, variables, strict=True)}

    def robots(self) -> dict[str, NDArray[np.int64]]:
        """Variables of every robot in the order of its path; robots in the order in which they started."""
        return {robot: variables.values.copy() for robot, variables in self._variables.items()}

    def state(self) -> State:
        """The state that ``restore`` needs."""
        edges = self.graph.given()
        return {
            "initial": self.graph.poses(),
            "poses": self._poses.values,
            "edges": {field.name: getattr(edges, field.name) for field in fields(edges)},
            "left_out": sorted(self._left_out),
            "unsolved": self._unsolved,
            "changed": sorted(self._changed),
            "paths": {
                robot: {
                    "variables": variables.values,
                    "chain": self._chains[robot].values,
                    "steps": self._step_covariance[robot].values,
                }
                for robot, variables in self._variables.items()
            },
        }

    def restore(self, state: State) -> None:
        """Take over a ``state``."""
        self.graph = PoseGraph.restored(state["initial"], EdgeArrays(**state["edges"]))
        self._poses = Rows(state["poses"])
        self._left_out, self._unsolved = set(state["left_out"]), state["unsolved"]
        self._changed = set(state["changed"])
        self._closures = int(state["edges"]["robust"].sum())
        for robot, path in state["paths"].items():
            self._variables[robot] = Rows(path["variables"])
            self._chains[robot], self._step_covariance[robot] = Rows(path["chain"]), Rows(path["steps"])

    def _kept(self) -> NDArray[np.bool_]:
        kept = np.ones(self.graph.edge_count, dtype=bool)
        kept[list(self._left_out)] = False
        return kept

    def _add_variable(self, pose: FloatArray) -> int:
        self._poses.append(pose)
        return self.graph.add_variable(pose)
