"""LiDAR SLAM of one robot, as in Karto: scan tracking, a pose graph of keyscans, loop closures between submaps."""

from bisect import bisect_left, bisect_right
from dataclasses import dataclass

import numpy as np
from pydantic import Field

from fcslam.config import Settings
from fcslam.geometry import se2
from fcslam.graph.factors import FactorCache, Loss
from fcslam.graph.optimizer import optimize, optimize_gnc
from fcslam.graph.pose_graph import Edge, PoseGraph
from fcslam.lidar.closing import AnchoredSubmap, ClosingConfig, LocalClosure, LoopCloser, PlaceRecognizer
from fcslam.lidar.correlative import SearchConfig
from fcslam.lidar.lasers import Lasers
from fcslam.lidar.odometry import OdometryConfig, odometry_error
from fcslam.lidar.scan import PointScan, point_scan
from fcslam.lidar.submap import Submap, build_submap
from fcslam.lidar.tracker import ScanTracker, TrackedScan, TrackerConfig, TrackingResult
from fcslam.lidar.verification import VerificationConfig
from fcslam.records import (
    Constraint,
    ConstraintKind,
    FloatArray,
    Keyscan,
    KeyscanId,
    LaserModel,
    LaserScan,
    Ranges,
    frozen,
)

SOLVE_AFTER, SOLVE_AFTER_SHARE = 20, 0.08
"""The graph is solved once this many closures wait, or this share of the number of keyscans if that is more. The time
of a solve grows with the graph, so solves become rarer and the mean cost per scan stays constant."""
TURN_AS_TRAVEL_M = 0.1
"""Travel that one radian of turning counts as, metres: a robot that only turns completes submaps, too."""

POINT_INFORMATION_SHARE = 0.1
"""Share of the points' information that counts: errors of neighbouring points are correlated, ten count as one."""
ODOMETRY_SIGMA_M, ODOMETRY_SIGMA_PER_TRAVEL = 0.01, 0.1
"""Standard deviation of odometry's position between two keyscans that were matched, in metres and per metre of travel.
It fixes what the points leave open, as along a corridor. It is smaller than in the tracker (``OdometryConfig``):
the match has shown that the wheels did not slip."""
ODOMETRY_SIGMA_RAD, ODOMETRY_SIGMA_PER_TURN = 0.005, 0.1
"""The same for the heading, in radians and per radian of turn."""
FLOOR_SIGMA_M, FLOOR_SIGMA_PER_TRAVEL = 0.003, 0.01
"""Least standard deviation of the position between two keyscans, in metres and per metre of travel: the error that more
points do not reduce."""
FLOOR_SIGMA_RAD, FLOOR_SIGMA_PER_TURN = 0.001, 0.01
"""The same for the heading, in radians and per radian of turn."""


class KeyscanConfig(Settings):
    """Which scans become keyscans, and the size of submaps."""

    minimum_travel_distance_m: float = Field(
        default=0.25, gt=0, description="travel since the last keyscan after which a scan becomes a keyscan [m]"
    )
    minimum_travel_heading_rad: float = Field(
        default=0.25, gt=0, description="turn since the last keyscan after which a scan becomes a keyscan [rad]"
    )
    submap_every_m: float = Field(default=2.0, gt=0, description="travel between the anchors of two submaps [m]")
    submap_reach_m: float = Field(
        default=5.0, gt=0, description="travel before and after its anchor that a submap covers [m]"
    )


class LidarConfig(Settings):
    """The LiDAR front end."""

    keyscans: KeyscanConfig = Field(default=KeyscanConfig(), description="keyscans and submaps")
    tracker: TrackerConfig = Field(default=TrackerConfig(), description="scan-to-submap tracking")
    closing: ClosingConfig = Field(default=ClosingConfig(), description="loop closing inside one robot")
    search: SearchConfig = Field(default=SearchConfig(), description="correlative search of loop closing")
    verification: VerificationConfig = Field(default=VerificationConfig(), description="verification of closures")


@dataclass(frozen=True, slots=True)
class ScanPose:
    """Pose of a scan relative to the keyscan before it."""

    stamp: float
    keyscan: int
    T_keyscan_base: FloatArray
    """Shape (3,), metres and radians."""


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


@dataclass(frozen=True, slots=True)
class Step:
    """Everything that one scan added."""

    pose: ScanPose
    keyscan: Keyscan | None = None
    odometry: Constraint | None = None
    submap: FinishedSubmap | None = None


class Mapper:
    """SLAM of one robot. Poses are in its own ``map``, where the first keyscan has its odometry pose."""

    def __init__(self, robot: str, config: LidarConfig, recognizer: PlaceRecognizer | None = None) -> None:
        """``recognizer`` proposes loops whose drift is beyond the reach of the search; without one they stay open."""
        self.robot = robot
        self.config = config
        self._tracker = ScanTracker(config.tracker)
        self._closer = LoopCloser(config.closing, config.search, config.verification, recognizer)
        self._graph = PoseGraph()
        self._factors = FactorCache(self._graph)
        self._lasers = Lasers()
        self._newest: dict[int, int] = {}  # number of the newest keyscan of each laser
        self._poses: list[FloatArray] = []  # T_map_base of each keyscan, optimised
        self._local: list[FloatArray] = []  # T_local_base of each keyscan, smooth
        self._travel: list[float] = []
        self._points: dict[int, PointScan] = {}
        self._next_anchor_m = 0.0
        self._unsolved = 0

    def localize(self, scan: LaserScan) -> TrackingResult:
        """Find the pose of the next scan; nothing changes before :meth:`process`."""
        return self._tracker.localize(scan)

    def process(self, scan: LaserScan, tracking: TrackingResult | None = None) -> Step:
        """Process the next scan.

        Args:
            scan: the scan.
            tracking: its result of :meth:`localize`, if that was called before.

        Returns:
            The pose of the scan, and what it added to the map.
        """
        # 1. Scan matching against the running buffer.
        tracking = self._tracker.localize(scan) if tracking is None else tracking
        self._tracker.commit(tracking)
        tracked = tracking.tracked
        # 2. Keyscan: after enough motion the scan becomes a variable of the pose graph.
        laser = self._lasers.index(scan.laser)
        if not self._is_keyscan(tracked, laser):
            return Step(self._scan_pose(scan.stamp, tracked))
        keyscan, odometry = self._add_keyscan(scan, tracked, laser)
        # 3. Submap and loop closing: a complete submap is compared with earlier ones; closures start a solve.
        submap = self._finish_submap()
        return Step(self._scan_pose(scan.stamp, tracked), keyscan, odometry, submap)

    @property
    def lasers(self) -> tuple[LaserModel, ...]:
        """The lasers whose scans were processed; keyscans name theirs by its index."""
        return self._lasers.known

    @property
    def travel_m(self) -> float:
        """Path length up to the newest keyscan, metres; turns count as ``TURN_AS_TRAVEL_M`` per radian."""
        return self._travel[-1] if self._travel else 0.0

    def recent_submap(self) -> tuple[Submap, FloatArray]:
        """The submap of the last ``submap_reach_m`` of travel.

        Returns:
            The submap, in the base of the newest keyscan, and ``T_local_base`` of this keyscan, shape (3,).
        """
        anchor = self._local[-1]
        first = bisect_left(self._travel, self._travel[-1] - self.config.keyscans.submap_reach_m)
        numbers = range(first, len(self._local))
        return build_submap([(self._points[k], se2.between(anchor, self._local[k])) for k in numbers]), anchor

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

    def _is_keyscan(self, tracked: TrackedScan, laser: int) -> bool:
        """Whether the robot moved enough since the last keyscan of this laser; so each of them maps what it sees."""
        if tracked.scan is None:
            return False
        if laser not in self._newest:
            return True
        motion = se2.between(self._local[self._newest[laser]], tracked.T_local_base)
        gate = self.config.keyscans
        return bool(
            np.hypot(motion[0], motion[1]) >= gate.minimum_travel_distance_m
            or abs(motion[2]) >= gate.minimum_travel_heading_rad
        )

    def _scan_pose(self, stamp: float, tracked: TrackedScan) -> ScanPose:
        number = len(self._local) - 1
        return ScanPose(stamp, number, se2.between(self._local[number], tracked.T_local_base))

    def _add_keyscan(self, scan: LaserScan, tracked: TrackedScan, laser: int) -> tuple[Keyscan, Constraint | None]:
        """Add a variable to the pose graph, with a constraint to the keyscan before it."""
        points = tracked.scan or point_scan(scan.ranges_m, scan.laser)
        number = len(self._local)
        self._tracker.insert(points, tracked.T_local_base, len(self.lasers))
        self._points[number] = points
        self._newest[laser] = number
        ranges_m, announced = _valid_ranges(scan.ranges_m, scan.laser.max_range_m), self.lasers[laser]
        beams = None if scan.laser == announced else scan.laser.beams
        keyscan = Keyscan(KeyscanId(self.robot, number), scan.stamp, ranges_m, laser, beams)
        if number == 0:
            start = np.array(scan.T_odom_base)
            self._local.append(tracked.T_local_base)
            self._poses.append(start)
            self._travel.append(0.0)
            self._graph.add_variable(start)
            return keyscan, None
        motion = se2.between(self._local[-1], tracked.T_local_base)
        constraint = Constraint(
            self.robot, number - 1, number, ConstraintKind.ODOMETRY, frozen(motion),
            frozen(motion_information(motion, tracked, self.config.tracker.odometry)),
        )  # fmt: skip
        self._local.append(tracked.T_local_base)
        self._poses.append(se2.compose(self._poses[-1], motion))
        progress = float(np.hypot(motion[0], motion[1])) + TURN_AS_TRAVEL_M * abs(float(motion[2]))
        self._travel.append(self._travel[-1] + progress)
        self._graph.add_variable(self._poses[-1])
        self._graph.add_edge(Edge(number - 1, number, constraint.T_i_j, constraint.information, robust=False))
        return keyscan, constraint

    def _finish_submap(self, at_end: bool = False) -> FinishedSubmap | None:
        """Build the next submap once the robot is far enough past its anchor, and close loops to earlier ones."""
        gate, travel = self.config.keyscans, self._travel
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


def motion_information(motion: FloatArray, tracked: TrackedScan, odometry: OdometryConfig) -> FloatArray:
    """Information of the motion between two consecutive keyscans.

    The sum of the points' information and odometry's, limited by a floor of the standard deviations.

    Args:
        motion: pose of the later keyscan in the earlier one, shape (3,), metres and radians.
        tracked: the later keyscan.
        odometry: error of the odometry, used if the scan was not matched.

    Returns:
        Information in the tangent space at ``motion`` (x, y, theta of the later keyscan), shape (3, 3).
    """
    moved, turned = float(np.hypot(motion[0], motion[1])), abs(float(motion[2]))
    cos, sin = np.cos(tracked.T_local_base[2]), np.sin(tracked.T_local_base[2])
    turn = np.array(((cos, -sin, 0.0), (sin, cos, 0.0), (0.0, 0.0, 1.0)))
    sigma_m = ODOMETRY_SIGMA_M + ODOMETRY_SIGMA_PER_TRAVEL * moved
    sigma_rad = ODOMETRY_SIGMA_RAD + ODOMETRY_SIGMA_PER_TURN * turned
    prior = np.diag((sigma_m**-2, sigma_m**-2, sigma_rad**-2))
    if not tracked.information.any():  # odometry alone, and the wheels may have slipped
        prior = odometry_error(moved, turned, odometry).information
    covariance = np.linalg.inv(POINT_INFORMATION_SHARE * turn.T @ tracked.information @ turn + prior)
    floor_m = FLOOR_SIGMA_M + FLOOR_SIGMA_PER_TRAVEL * moved
    floor_rad = FLOOR_SIGMA_RAD + FLOOR_SIGMA_PER_TURN * turned
    floor = np.diag((floor_m**2, floor_m**2, floor_rad**2))
    information = np.linalg.inv(covariance + floor)
    return np.asarray(0.5 * (information + information.T))


def _valid_ranges(ranges_m: Ranges, max_range_m: float) -> Ranges:
    """Ranges of a keyscan, metres; invalid ones become 0."""
    valid = np.isfinite(ranges_m) & (ranges_m > 0.0) & (ranges_m < max_range_m)
    return frozen(np.where(valid, ranges_m, 0.0), np.float32)
