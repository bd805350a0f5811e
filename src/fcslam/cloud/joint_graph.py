"""The pose graph of the whole fleet: every robot's keyscans, their constraints, the closures between robots."""

from collections.abc import Collection, Sequence

import numpy as np

from fcslam.geometry import se2
from fcslam.graph.factors import FactorCache, Loss
from fcslam.graph.optimizer import optimize, optimize_gnc
from fcslam.graph.pose_graph import Edge, PoseGraph
from fcslam.records import Constraint, FloatArray, KeyscanId


class JointGraph:
    """Grows with the packets; poses of robots in different maps are each in their own map's frame."""

    def __init__(self) -> None:
        self.graph = PoseGraph()
        self._factors = FactorCache(self.graph)
        self._variables: dict[str, list[int]] = {}
        self._chains: dict[str, list[FloatArray]] = {}
        self._poses = np.zeros((256, 3))
        self._weights = np.ones(0)
        self._unsolved = 0

    def variable(self, keyscan: KeyscanId) -> int:
        """Number of the keyscan's variable."""
        return self._variables[keyscan.robot][keyscan.number]

    def keyscan_count(self, robot: str) -> int:
        """Keyscans of the robot that hang in the graph."""
        return len(self._variables.get(robot, ()))

    def pose(self, keyscan: KeyscanId) -> FloatArray:
        """T_map_base of the keyscan in its robot's present map."""
        pose: FloatArray = self._poses[self.variable(keyscan)]
        return pose

    def trajectory(self, robot: str) -> FloatArray:
        """T_map_base of the robot's keyscans, shape (N, 3)."""
        trajectory: FloatArray = self._poses[self._variables[robot]]
        return trajectory

    def chain(self, robot: str, first: int, last: int) -> FloatArray:
        """T_odom_base of keyscans first to last (inclusive): the robot's motions alone, before any correction."""
        return np.array(self._chains[robot][first : last + 1])

    def T_map_odom(self, robot: str) -> FloatArray:
        """Where the robot's odometry (the chain of its motions) starts in the map, by its newest keyscan."""
        return se2.compose(self._poses[self._variables[robot][-1]], se2.inverse(self._chains[robot][-1]))

    def start(self, robot: str) -> None:
        """First keyscan of a robot: the origin of a map of its own."""
        self._chains[robot] = [np.zeros(3)]
        self._variables[robot] = [self._add_variable(np.zeros(3))]

    def extend(self, constraint: Constraint) -> None:
        """A robot's motion to its next keyscan."""
        robot = constraint.robot
        previous = self._variables[robot][-1]
        variable = self._add_variable(se2.compose(self._poses[previous], constraint.T_i_j))
        self._variables[robot].append(variable)
        self._chains[robot].append(se2.compose(self._chains[robot][-1], constraint.T_i_j))
        self.graph.add_edge(Edge(previous, variable, constraint.T_i_j, constraint.information, robust=False))

    def close(self, i: KeyscanId, j: KeyscanId, T_i_j: FloatArray, information: FloatArray) -> int:
        """A closure; returns the number of its edge."""
        self._unsolved += 1
        return self.graph.add_edge(Edge(self.variable(i), self.variable(j), T_i_j, information, robust=True))

    def innovation(self, i: KeyscanId, j: KeyscanId, T_i_j: FloatArray) -> FloatArray:
        """How far a measurement lies from the estimate, (x, y, theta)."""
        return se2.between(se2.between(self.pose(i), self.pose(j)), T_i_j)

    def move(self, robots: Sequence[str], T_new_old: FloatArray) -> None:
        """Put the robots of one map into another map's frame."""
        for robot in robots:
            variables = self._variables[robot]
            self._poses[variables] = se2.compose(T_new_old, self._poses[variables])

    def is_due(self, closures: int) -> bool:
        """Whether that many closures came in since the last solve."""
        return self._unsolved >= closures

    def optimize(self) -> None:
        """Quick solve (Levenberg-Marquardt with a Cauchy loss on closures)."""
        solution = optimize(self.graph, self._poses[: len(self.graph)], loss=Loss.CAUCHY, factors=self._factors)
        self._take(solution.poses, solution.weights)

    def optimize_robustly(self, dropped: Collection[int] = ()) -> None:
        """Solve that decides for every closure whether it holds (graduated non-convexity); ``dropped`` ones do not."""
        if not dropped:
            solution = optimize_gnc(self.graph, self._poses[: len(self.graph)], factors=self._factors)
            self._take(solution.poses, solution.weights)
            return
        solution = optimize_gnc(self.optimized(dropped))
        weights = np.zeros(len(self.graph.edges))
        weights[[number for number in range(len(weights)) if number not in dropped]] = solution.weights
        self._take(solution.poses, weights)

    def weight(self, edge: int) -> float:
        """What the closure counted for in the last solve, in [0, 1]; 1 before its first."""
        return float(self._weights[edge]) if edge < len(self._weights) else 1.0

    def optimized(self, dropped: Collection[int] = ()) -> PoseGraph:
        """The graph with its present poses, without the edges in ``dropped``: what a run leaves behind."""
        edges = [edge for number, edge in enumerate(self.graph.edges) if number not in dropped]
        return PoseGraph(self._poses[: len(self.graph)], edges)

    def maps(self, accepted: Sequence[int]) -> list[list[str]]:
        """Robots by map, connected by the given closure edges; the largest map first, then by the robots' order."""
        kept = ~self.graph.arrays().robust
        kept[list(accepted)] = True
        components = self.graph.components(kept) if len(self.graph) else np.zeros(0, np.int64)
        groups: dict[int, list[str]] = {}
        for robot, variables in self._variables.items():
            groups.setdefault(int(components[variables[0]]), []).append(robot)
        return sorted(groups.values(), key=lambda robots: -len(robots))

    def _take(self, poses: FloatArray, weights: FloatArray) -> None:
        self._poses[: len(poses)] = poses
        self._weights = weights
        self._unsolved = 0

    def _add_variable(self, pose: FloatArray) -> int:
        variable = self.graph.add_variable(pose)
        if variable == len(self._poses):
            self._poses = np.concatenate([self._poses, np.zeros_like(self._poses)])
        self._poses[variable] = pose
        return variable
