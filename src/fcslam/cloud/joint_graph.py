"""The pose graph of the whole fleet: every robot's keyscans, their constraints, the closures between robots."""

from collections.abc import Container, Iterable, Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from fcslam.geometry import se2
from fcslam.graph.contradiction import strained_pairs
from fcslam.graph.factors import FactorCache, Loss
from fcslam.graph.optimizer import optimize
from fcslam.graph.pose_graph import Edge, EdgeArrays, PoseGraph
from fcslam.graph.trajectory import DriftSettings, Trajectory, build_trajectory
from fcslam.records import Constraint, FloatArray, KeyscanId
from fcslam.storage.state_file import State

SOLVED_SHARE = 0.05
"""Share of all closures that comes in between two solves, at least."""


class JointGraph:
    """Grows with the packets; poses of robots in different maps are each in their own map's frame."""

    def __init__(self) -> None:
        self.graph = PoseGraph()
        self._factors = FactorCache(self.graph)
        self._variables: dict[str, list[int]] = {}
        self._chains: dict[str, list[FloatArray]] = {}
        self._step_covariance: dict[str, list[FloatArray]] = {}
        self._poses = np.zeros((256, 3))
        self._left_out: set[int] = set()
        self._closures = self._unsolved = 0
        """Closures in the graph, and those that came in since the last solve."""

    def variable(self, keyscan: KeyscanId) -> int:
        """Number of the keyscan's variable."""
        return self._variables[keyscan.robot][keyscan.number]

    def pose(self, keyscan: KeyscanId) -> FloatArray:
        """T_map_base (3,) of the keyscan in its robot's current map."""
        pose: FloatArray = self._poses[self.variable(keyscan)]
        return pose

    def poses(self, keyscans: Iterable[KeyscanId]) -> FloatArray:
        """T_map_base of the keyscans, each in its robot's current map, shape (N, 3)."""
        poses: FloatArray = self._poses[[self._variables[robot][number] for robot, number in keyscans]].reshape(-1, 3)
        return poses

    def trajectory(self, robot: str) -> FloatArray:
        """T_map_base of the robot's keyscans, shape (N, 3)."""
        trajectory: FloatArray = self._poses[self._variables[robot]]
        return trajectory

    def path(self, robot: str, settings: DriftSettings) -> Trajectory:
        """The robot's trajectory with the covariance of its odometry, for consistency checks."""
        steps = np.array(self._step_covariance[robot]).reshape(-1, 3, 3)
        return build_trajectory(self.trajectory(robot), settings, steps)

    def chain(self, robot: str, first: int = 0, last: int | None = None) -> FloatArray:
        """T_odom_base (N, 3) of keyscans first to last (inclusive), by the robot's motions without any closure."""
        end = None if last is None else last + 1
        return np.array(self._chains[robot][first:end])

    def T_map_odom(self, robot: str, T_map_newest: FloatArray | None = None) -> FloatArray:
        """Where the robot's odometry (the chain of its motions) starts in the map, by its newest keyscan.

        ``T_map_newest`` (3,) says where that is, by default where it is estimated now.
        """
        T_map_base = self._poses[self._variables[robot][-1]] if T_map_newest is None else T_map_newest
        return se2.compose(T_map_base, se2.inverse(self._chains[robot][-1]))

    def start(self, robot: str) -> None:
        """First keyscan of a robot: the origin of a map of its own."""
        self._chains[robot] = [np.zeros(3)]
        self._step_covariance[robot] = []
        self._variables[robot] = [self._add_variable(np.zeros(3))]

    def extend(self, constraint: Constraint) -> None:
        """A robot's motion to its next keyscan."""
        robot = constraint.robot
        previous = self._variables[robot][-1]
        variable = self._add_variable(se2.compose(self._poses[previous], constraint.T_i_j))
        self._variables[robot].append(variable)
        self._step_covariance[robot].append(np.asarray(np.linalg.inv(constraint.information)))
        self._chains[robot].append(se2.compose(self._chains[robot][-1], constraint.T_i_j))
        self.graph.add_edge(Edge(previous, variable, constraint.T_i_j, constraint.information, robust=False))

    def close(self, i: KeyscanId, j: KeyscanId, T_i_j: FloatArray, information: FloatArray) -> int:
        """A closure; returns the number of its edge."""
        self._unsolved += 1
        self._closures += 1
        return self.graph.add_edge(Edge(self.variable(i), self.variable(j), T_i_j, information, robust=True))

    def innovation(self, i: KeyscanId, j: KeyscanId, T_i_j: FloatArray) -> FloatArray:
        """Difference of a measurement T_i_j (3,) and the estimate: (x, y, theta), in metres and radians."""
        return se2.between(se2.between(self.pose(i), self.pose(j)), T_i_j)

    def move(self, robots: Sequence[str], T_new_old: FloatArray) -> None:
        """Move the robots of one map into another map's coordinate frame."""
        for robot in robots:
            variables = self._variables[robot]
            self._poses[variables] = se2.compose(T_new_old, self._poses[variables])

    def is_due(self, closures: int) -> bool:
        """Whether that many closures came in since the last solve, and the graph has grown noticeably.

        A solve costs as much as the graph is large: growth by a constant share keeps the cost per closure constant.
        """
        return self._unsolved >= max(closures, SOLVED_SHARE * self._closures)

    def count(self, edge: int, *, holds: bool) -> None:
        """Include the closure in the next solves, or exclude it."""
        (self._left_out.discard if holds else self._left_out.add)(edge)

    def optimize(self) -> None:
        """Quick solve (Levenberg-Marquardt with a Cauchy loss on closures)."""
        start = self._poses[: len(self.graph)]
        self.take(optimize(self.graph, start, loss=Loss.CAUCHY, kept=self._kept(), factors=self._factors).poses)

    def is_strained(self, limit: float) -> bool:
        """Whether the mean chi-square of the closures between two robots is over the limit: they may contradict."""
        owner = np.zeros(len(self.graph), np.int64)
        for number, variables in enumerate(self._variables.values()):
            owner[variables] = number
        poses = self._poses[: len(self.graph)]
        return bool(strained_pairs(self.graph, owner, poses, self._kept(), limit))

    def take(self, poses: FloatArray) -> None:
        """Replace the estimate by a solution, shape (N, 3)."""
        self._poses[: len(poses)] = poses
        self._unsolved = 0

    def held(self, T_map_base: Mapping[str, FloatArray], left_out: Container[int | None]) -> PoseGraph:
        """These robots at poses (N, 3), with the constraints that are not left out: the graph of a finished run.

        No constraint that connects one of them with another robot is kept.
        """
        kept, poses = np.zeros(len(self.graph), bool), np.zeros((len(self.graph), 3))
        for robot, T_robot in T_map_base.items():
            poses[self._variables[robot]], kept[self._variables[robot]] = T_robot, True
        edges = [edge for number, edge in enumerate(self.graph.edges) if number not in left_out]
        if not kept.all():
            numbers = np.cumsum(kept) - 1
            inside = (edge for edge in edges if kept[edge.i] and kept[edge.j])
            edges = [replace(edge, i=int(numbers[edge.i]), j=int(numbers[edge.j])) for edge in inside]
        return PoseGraph(poses[kept], edges)

    def robots(self) -> dict[str, NDArray[np.int64]]:
        """Variables of every robot in the order of its path; robots in the order in which they started."""
        return {robot: np.array(variables, dtype=np.int64) for robot, variables in self._variables.items()}

    def state(self) -> State:
        """What ``restore`` needs."""
        count, edges = len(self.graph), self.graph.given()
        return {
            "initial": self.graph.poses(),
            "poses": self._poses[:count],
            "edges": {"i": edges.i, "j": edges.j, "T_i_j": edges.T_i_j, "information": edges.information,
                      "robust": edges.robust},
            "left_out": sorted(self._left_out),
            "unsolved": self._unsolved,
            "robots": list(self._variables),
            "paths": {
                robot: {
                    "variables": np.array(variables, np.int64),
                    "chain": np.array(self._chains[robot]),
                    "steps": np.array(self._step_covariance[robot]).reshape(-1, 3, 3),
                }
                for robot, variables in self._variables.items()
            },
        }  # fmt: skip

    def restore(self, state: State) -> None:
        """Take over a ``state``."""
        self.graph = PoseGraph.restored(state["initial"], EdgeArrays(**state["edges"]))
        self._factors = FactorCache(self.graph)
        self._poses = np.concatenate([state["poses"], np.zeros((max(256, len(self.graph)), 3))])
        self._left_out, self._unsolved = set(state["left_out"]), state["unsolved"]
        self._closures = int(state["edges"]["robust"].sum())
        for robot in state["robots"]:
            path = state["paths"][robot]
            self._variables[robot] = path["variables"].tolist()
            self._chains[robot], self._step_covariance[robot] = list(path["chain"]), list(path["steps"])

    def _kept(self) -> NDArray[np.bool_]:
        """Edges that count, shape (E,)."""
        kept = np.ones(len(self.graph.edges), dtype=bool)
        kept[list(self._left_out)] = False
        return kept

    def _add_variable(self, pose: FloatArray) -> int:
        variable = self.graph.add_variable(pose)
        if variable == len(self._poses):
            self._poses = np.concatenate([self._poses, np.zeros_like(self._poses)])
        self._poses[variable] = pose
        return variable
