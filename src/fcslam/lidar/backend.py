"""Back end of one robot's LiDAR SLAM: submaps, loop closures between them, and the pose graph of keyscans (Karto)."""

from bisect import bisect_left, bisect_right
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fcslam.geometry import se2
from fcslam.graph.least_squares import Loss
from fcslam.graph.optimizer import optimize, optimize_gnc
from fcslam.graph.pose_graph import Edge, PoseGraph
from fcslam.graph.trajectory import transport_covariance
from fcslam.lidar.closing import LocalClosure, LoopCloser, PlaceRecognizer
from fcslam.lidar.frontend import SUBMAP_REACH_M, LidarConfig, MappedKeyscan
from fcslam.lidar.submap import Submap, build_submap
from fcslam.records import Constraint, ConstraintKind, FloatArray, frozen

SOLVE_AFTER_SHARE = 0.08
"""The graph is solved once more closures wait than this share of the number of keyscans. The time of a solve grows with
the graph, so solves become rarer and the mean cost per scan stays constant."""

DENSE_M = 50.0
"""Travel from the beginning of a session with twice as dense submaps, metres: robots that just met have few places."""


@dataclass(frozen=True, slots=True)
class FinishedSubmap:
    """A complete submap: its surfaces, and the closures that were accepted with it."""

    anchor: int
    first: int
    last: int
    """First and last keyscan of the submap."""
    surface: FloatArray
    """Points of the surfaces in the anchor's base, shape (N, 2), metres."""
    closures: tuple[Constraint, ...]


class LidarBackend:
    """Maps the keyscans of one robot. Poses are in its own ``map``, where the first keyscan has its odometry pose.

    The variables of the pose graph are the anchors of the submaps. The keyscans between two anchors are marginalised:
    their odometry is one constraint. So a solve is ten times cheaper than with a variable for each keyscan.
    """

    def __init__(self, robot: str, config: LidarConfig, recognizer: PlaceRecognizer | None = None) -> None:
        """``recognizer`` proposes loops whose drift is beyond the reach of the search; without one they stay open."""
        self.robot = robot
        self._gate = config.keyscans
        self._closer = LoopCloser(recognizer)
        self._graph = PoseGraph()
        self._poses = np.empty((0, 3))
        """``T_map_base`` of each anchor, optimized."""
        self._window: list[MappedKeyscan] = []
        """The newest keyscans, as far back as the next submaps need them."""
        self._T_local_base: list[FloatArray] = []
        """Pose of every keyscan, as the tracker found it."""
        self._next_anchor_m = 0.0
        self._unsolved = 0

    def add(self, keyscan: MappedKeyscan) -> FinishedSubmap | None:
        """Add the next keyscan; returns the submap that it completes, if it completes one."""
        self._window.append(keyscan)
        self._T_local_base.append(keyscan.T_local_base)
        return self._finish_submap()

    def finish(self) -> list[FinishedSubmap]:
        """Complete the submaps that are still open at the end of the recording."""
        rest = []
        while submap := self._finish_submap(at_end=True):
            rest.append(submap)
        return rest

    def keyscan_poses(self) -> FloatArray:
        """``T_map_base`` of every keyscan so far, shape (N, 3), after a robust solve that changes nothing here.

        Before the first submap is complete, the poses are those of the tracker, in its frame.
        """
        local, anchors = np.array(self._T_local_base).reshape(-1, 3), np.array(self._closer.keyscans)
        if not len(anchors):
            return local
        poses = optimize_gnc(self._graph, self._poses).poses if self._closer.has_closures else self._poses
        before = np.maximum(np.searchsorted(anchors, np.arange(len(local)), "right") - 1, 0)
        return se2.compose(poses[before], se2.between(local[anchors[before]], local))

    def _finish_submap(self, at_end: bool = False) -> FinishedSubmap | None:
        gate, window = self._gate, self._window
        if not at_end and window[-1].travel_m < self._next_anchor_m + SUBMAP_REACH_M:
            return None
        travel = [keyscan.travel_m for keyscan in window]
        middle = bisect_left(travel, self._next_anchor_m)
        if middle == len(window) or (not at_end and travel[-1] < travel[middle] + SUBMAP_REACH_M):
            return None
        anchor = window[middle]
        self._next_anchor_m = anchor.travel_m + gate.submap_every_m * (0.5 if anchor.travel_m < DENSE_M else 1.0)
        first = bisect_left(travel, anchor.travel_m - SUBMAP_REACH_M)
        last = bisect_right(travel, anchor.travel_m + SUBMAP_REACH_M) - 1
        submap = build_submap(
            [(k.points, se2.between(anchor.T_local_base, k.T_local_base)) for k in window[first : last + 1]]
        )
        self._add_anchor(anchor)
        self._window = window[first:]
        number = anchor.record.id.number
        closures = self._close_loops(number, anchor.travel_m, submap)
        ends = number + first - middle, number + last - middle
        return FinishedSubmap(number, *ends, submap.surface.points, closures)

    def _add_anchor(self, anchor: MappedKeyscan) -> None:
        if not self._closer.keyscans:
            self._poses = anchor.T_odom_base[None]
            self._graph.add_variable(anchor.T_odom_base)
            return
        between = range(self._closer.keyscans[-1] + 1, anchor.record.id.number + 1)
        motions = [k.odometry for k in self._window if k.odometry is not None and k.record.id.number in between]
        T_before_anchor, information = chained(motions)
        pose = se2.compose(self._poses[-1], T_before_anchor)
        variable = self._graph.add_variable(pose)
        self._graph.add_edge(Edge(variable - 1, variable, T_before_anchor, information, robust=False))
        self._poses = np.vstack((self._poses, pose))

    def _close_loops(self, keyscan: int, travel_m: float, submap: Submap) -> tuple[Constraint, ...]:
        closures = self._closer.add(keyscan, travel_m, submap, self._poses)
        for c in closures:
            self._graph.add_edge(Edge(c.earlier, c.later, c.check.T_a_b, c.check.information, robust=True))
        self._optimize_if_needed(closures)
        keyscans = self._closer.keyscans
        return tuple(
            Constraint(
                self.robot,
                keyscans[c.earlier],
                keyscans[c.later],
                ConstraintKind.CLOSURE,
                frozen(c.check.T_a_b),
                frozen(c.check.information),
            )
            for c in closures
        )

    def _optimize_if_needed(self, closures: list[LocalClosure]) -> None:
        """Solve at once if a closure contradicts the estimate, otherwise after some closures.

        A recognised loop may contradict it by so much that the Cauchy loss hardly pulls; only GNC closes it.
        """
        self._unsolved += len(closures)
        if any(c.beyond_search for c in closures):
            self._poses = optimize_gnc(self._graph, self._poses).poses
            self._unsolved = 0
        elif self._unsolved > SOLVE_AFTER_SHARE * len(self._T_local_base) or any(c.is_surprising for c in closures):
            self._poses = optimize(self._graph, self._poses, loss=Loss.CAUCHY).poses
            self._unsolved = 0


def chained(motions: Sequence[Constraint]) -> tuple[FloatArray, FloatArray]:
    """Combine consecutive motions of a chain, one or more, into one: its pose (3,) and information (3, 3).

    The information is in the tangent space at the motion, to first order in the errors.
    """
    after = [se2.IDENTITY]  # motion from the end of each one to the end of the chain, where covariances are added
    for motion in reversed(motions):
        after.append(se2.compose(motion.T_i_j, after[-1]))
    T_first_last = after.pop()
    covariances = np.linalg.inv(np.array([motion.information for motion in motions]))
    information = np.linalg.inv(transport_covariance(covariances, np.array(after[::-1])).sum(axis=0))
    return T_first_last, 0.5 * (information + information.T)
