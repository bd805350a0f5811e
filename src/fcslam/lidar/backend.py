"""Back end of one robot's LiDAR SLAM: submaps, loop closures between them, and the pose graph of keyscans (Karto).

Its state is a function of the keyscans in their order, whenever it gets them.
"""

from bisect import bisect_left, bisect_right
from dataclasses import dataclass

import numpy as np

from fcslam.geometry import se2
from fcslam.graph.factors import FactorCache, Loss
from fcslam.graph.optimizer import optimize, optimize_gnc
from fcslam.graph.pose_graph import Edge, PoseGraph
from fcslam.lidar.closing import AnchoredSubmap, LocalClosure, LoopCloser, PlaceRecognizer
from fcslam.lidar.frontend import LidarConfig, MappedKeyscan
from fcslam.lidar.scan import PointScan
from fcslam.lidar.submap import build_submap
from fcslam.records import Constraint, ConstraintKind, FloatArray, frozen

SOLVE_AFTER, SOLVE_AFTER_SHARE = 20, 0.08
"""The graph is solved once this many closures wait, or this share of the number of keyscans if that is more. The time
of a solve grows with the graph, so solves become rarer and the mean cost per scan stays constant."""


@dataclass(frozen=True, slots=True)
class FinishedSubmap:
    """A complete submap: its surfaces, and the closures that were accepted with it."""

    anchor: int
    first: int
    """First keyscan of the submap."""
    last: int
    """Last one (inclusive)."""
    surface: FloatArray
    """Points of the surfaces in the anchor's base, shape (N, 2), metres."""
    closures: tuple[Constraint, ...]


class LidarBackend:
    """Maps the keyscans of one robot. Poses are in its own ``map``, where the first keyscan has its odometry pose."""

    def __init__(self, robot: str, config: LidarConfig, recognizer: PlaceRecognizer | None = None) -> None:
        """``recognizer`` proposes loops whose drift is beyond the reach of the search; without one they stay open."""
        self.robot = robot
        self._keyscans = config.keyscans
        self._closer = LoopCloser(config.closing, config.search, config.verification, recognizer)
        self._graph = PoseGraph()
        self._factors = FactorCache(self._graph)
        self._poses: list[FloatArray] = []  # T_map_base of each keyscan, optimised
        self._local: list[FloatArray] = []  # T_local_base of each keyscan, smooth
        self._travel: list[float] = []
        self._points: dict[int, PointScan] = {}
        self._next_anchor_m = 0.0
        self._unsolved = 0

    def add(self, keyscan: MappedKeyscan) -> FinishedSubmap | None:
        """Add the next keyscan; returns the submap that it completes, if it completes one."""
        self._points[len(self._local)] = keyscan.points
        self._local.append(keyscan.T_local_base)
        self._travel.append(keyscan.travel_m)
        motion = keyscan.odometry
        pose = keyscan.T_odom_base if motion is None else se2.compose(self._poses[-1], motion.T_i_j)
        self._poses.append(pose)
        self._graph.add_variable(pose)
        if motion is not None:
            self._graph.add_edge(Edge(motion.i, motion.j, motion.T_i_j, motion.information, robust=False))
        return self._finish_submap()

    def finish(self) -> list[FinishedSubmap]:
        """Complete the submaps that are still open at the end of the recording."""
        rest = []
        while submap := self._finish_submap(at_end=True):
            rest.append(submap)
        return rest

    def optimized(self) -> FloatArray:
        """``T_map_base`` of every keyscan after a robust solve (GNC), shape (N, 3), metres and radians."""
        if self._closer.has_closures:
            self._poses = list(optimize_gnc(self._graph, self._poses, factors=self._factors).poses)
        return np.array(self._poses).reshape(-1, 3)

    def _finish_submap(self, at_end: bool = False) -> FinishedSubmap | None:
        """Build the next submap once the robot is far enough past its anchor, and close loops to earlier ones."""
        gate, travel = self._keyscans, self._travel
        anchor = bisect_left(travel, self._next_anchor_m)
        if anchor == len(travel) or (not at_end and travel[-1] < travel[anchor] + gate.submap_reach_m):
            return None
        self._next_anchor_m = travel[anchor] + gate.submap_every_m
        first = bisect_left(travel, travel[anchor] - gate.submap_reach_m)
        last = bisect_right(travel, travel[anchor] + gate.submap_reach_m) - 1
        T_anchor = [se2.between(self._local[anchor], self._local[k]) for k in range(first, last + 1)]
        submap = build_submap([(self._points[first + k], pose) for k, pose in enumerate(T_anchor)])
        for number in [k for k in self._points if k < first]:
            del self._points[number]
        closures = self._close_loops(AnchoredSubmap(anchor, travel[anchor], submap))
        return FinishedSubmap(anchor, first, last, submap.surface.points, closures)

    def _close_loops(self, submap: AnchoredSubmap) -> tuple[Constraint, ...]:
        """Compare a new submap with earlier ones; accepted closures become constraints."""
        closures = self._closer.add(submap, self._poses)
        constraints = tuple(self._constraint(closure) for closure in closures)
        for c in constraints:
            self._graph.add_edge(Edge(c.i, c.j, c.T_i_j, c.information, robust=True))
        self._optimize_if_needed(closures)
        return constraints

    def _constraint(self, closure: LocalClosure) -> Constraint:
        submaps = self._closer.submaps
        return Constraint(
            self.robot, submaps[closure.earlier].keyscan, submaps[closure.later].keyscan, ConstraintKind.CLOSURE,
            frozen(closure.check.T_a_b), frozen(closure.check.information),
        )  # fmt: skip

    def _optimize_if_needed(self, closures: list[LocalClosure]) -> None:
        """Solve at once if a closure contradicts the estimate, otherwise after ``SOLVE_AFTER`` closures.

        A recognised loop may contradict it by so much that the Cauchy loss hardly pulls; only GNC closes it.
        """
        self._unsolved += len(closures)
        enough = max(SOLVE_AFTER, SOLVE_AFTER_SHARE * len(self._local))
        if any(c.beyond_search for c in closures):
            self.optimized()
            self._unsolved = 0
        elif self._unsolved >= enough or any(c.is_surprising for c in closures):
            self._poses = list(optimize(self._graph, self._poses, loss=Loss.CAUCHY, factors=self._factors).poses)
            self._unsolved = 0
