"""Front end of one robot's LiDAR SLAM: the pose of every scan, keyscans and the motions between them.

It works in the smooth local frame of the tracker and never reads the pose graph, so the back end
(``fcslam.lidar.backend``) may run later or in another process without changing a result.
"""

import math
from collections import deque
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
from pydantic import Field

from fcslam.config import Settings
from fcslam.geometry import se2
from fcslam.geometry.beams import is_same_laser
from fcslam.lidar.evidence import CORRELATED, SIGMA_PER_TURN
from fcslam.lidar.karto import KartoTracker
from fcslam.lidar.matching import limited_information
from fcslam.lidar.odometry import WHEELS, OdometryModel, odometry_error
from fcslam.lidar.own_body import Polygon, Sectors
from fcslam.lidar.scan import PointScan, point_scan
from fcslam.lidar.submap import LEVER_M, Submap, build_submap
from fcslam.lidar.tracker import ScanTracker, TrackedScan, TrackingResult
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

TURN_AS_TRAVEL_M = 0.1
"""Travel that one radian of turning counts as, metres: a robot that only turns completes submaps, too."""

KEYSCAN_TURN_RAD = 0.25
"""Turn since the last keyscan after which a scan becomes a keyscan."""
SUBMAP_REACH_M = 5.0
"""Travel before and after its anchor that a submap covers."""
POINT_INFORMATION_SHARE = 1.0 / CORRELATED
"""Share of the points' information that counts: errors of neighbouring points are correlated."""
SCANS_ALONE_SHARE = 0.5
"""The same without wheels, where the velocity in a sweep is estimated, too, and has taken its part of the information.
With it, true errors are as large relative to the information as with wheels."""
ODOMETRY_SIGMA_M = 0.01
ODOMETRY_SIGMA_RAD = 0.5 * ODOMETRY_SIGMA_M
"""Constant part of the standard deviations of odometry between two keyscans that were matched, in metres and radians;
``SIGMA_PER_TURN`` of the travel and the turn comes on top. It fixes what the points leave open, as along a corridor. It
is smaller than in the tracker (``OdometryModel``): the match has shown that the wheels did not slip."""
FLOOR_SIGMA_M, FLOOR_SHARE = 0.003, 0.01
FLOOR_SIGMA_RAD = FLOOR_SIGMA_M / LEVER_M
"""Least standard deviations between two keyscans, in metres and radians, and their growth per travel and turn: the
error that more points do not reduce."""


class KeyscanConfig(Settings):
    """Which scans become keyscans, and the size of submaps."""

    minimum_travel_distance_m: float = Field(
        default=0.25, gt=0, description="travel since the last keyscan after which a scan becomes a keyscan [m]"
    )
    submap_every_m: float = Field(
        default=4.0,
        gt=0,
        description="travel between the anchors of two submaps, half of it as a session begins [m]",
    )


class LidarConfig(Settings):
    """The LiDAR front end."""

    scan_duration_s: float = Field(
        default=0.0,
        ge=0.0,
        le=1.0,
        description="time from the first beam of a scan, to which its stamp belongs, to the last one; for text logs "
        "and programs, because bags and ROS messages say it; 0: all beams are measured at once [s]",
    )
    ignore: Sectors = Field(
        default=(),
        description="sectors [from, to] whose beams are left out, as they see the robot itself; headings in base, "
        "counter-clockwise, which `fcslam info` proposes [deg]",
    )
    footprint: Polygon = Field(
        default=(),
        description="corners [[x, y], ...] of the robot's body in base, as the parameter `footprint` of Nav2; returns "
        "within it are left out [m]",
    )
    tracker: Literal["surfels", "karto"] = Field(
        default="surfels",
        description="how scans are matched: `surfels`, every scan by Gauss-Newton; `karto`, each scan that may become "
        "a keyscan by exhaustive search on a grid, as on the robots of the paper",
    )
    keyscans: KeyscanConfig = Field(default=KeyscanConfig(), description="keyscans and submaps")


class ScanPose(NamedTuple):
    """Pose of a scan relative to the keyscan before it."""

    stamp: float
    keyscan: int
    T_keyscan_base: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class MappedKeyscan:
    """A keyscan as the back end needs it."""

    record: Keyscan
    odometry: Constraint | None
    """Motion from the keyscan before; None for the first."""
    points: PointScan
    """Returns in its base."""
    T_odom_base: FloatArray
    """Pose by wheel odometry, shape (3,), metres and radians."""
    T_local_base: FloatArray
    """Pose in the tracker's smooth frame, shape (3,), metres and radians."""
    travel_m: float
    """Path length up to it, metres; turns count as ``TURN_AS_TRAVEL_M`` per radian."""


class LidarFrontend:
    """Tracks one robot scan by scan and selects keyscans."""

    def __init__(self, robot: str, config: LidarConfig, odometry: OdometryModel = WHEELS) -> None:
        self.robot = robot
        self.config = config
        self.odometry = odometry
        self.tracker = _tracker(config, odometry)
        self._lasers: list[LaserModel] = []
        """Each with the beams of its first scan."""
        self._count = 0
        self._newest: MappedKeyscan | None = None
        self._T_local_newest: dict[int, FloatArray] = {}
        """Pose of the newest keyscan of each laser."""
        self._begun_m = 0.0
        """Path length at which the local map began."""
        self._recent: deque[MappedKeyscan] = deque()
        """The keyscans of the last ``SUBMAP_REACH_M`` of travel."""

    def fresh(self) -> "LidarFrontend":
        """A front end of the same robot that has seen nothing."""
        return LidarFrontend(self.robot, self.config, self.odometry)

    def localize(self, scan: LaserScan) -> TrackingResult:
        """Find the pose of the next scan; nothing changes before ``process``."""
        return self.tracker.localize(scan)

    def process(self, scan: LaserScan, tracking: TrackingResult | None = None) -> tuple[ScanPose, MappedKeyscan | None]:
        """Process the next scan, with its result of ``localize`` if that was called before.

        Returns its pose, and the keyscan that it became.
        """
        # 1. Scan matching against the running buffer.
        tracking = self.tracker.localize(scan) if tracking is None else tracking
        self.tracker.commit(tracking)
        tracked = tracking.tracked
        # 2. After enough motion the scan becomes a keyscan.
        laser = laser_index(self._lasers, scan.laser)
        keyscan = self._add_keyscan(scan, tracked, laser) if self._is_keyscan(tracked, laser) else None
        return self.scan_pose(scan.stamp, tracked), keyscan

    @property
    def lasers(self) -> tuple[LaserModel, ...]:
        """The lasers whose scans were processed; keyscans name theirs by its index."""
        return tuple(self._lasers)

    @property
    def travel_m(self) -> float:
        """Path length up to the newest keyscan, metres; turns count as ``TURN_AS_TRAVEL_M`` per radian."""
        return 0.0 if self._newest is None else self._newest.travel_m

    @property
    def settled_m(self) -> float:
        """Path length since the local map began, metres; as ``travel_m``, unless another one was begun."""
        return self.travel_m - self._begun_m

    def begin_local_map(self) -> None:
        """Forget the surfaces seen so far. Only odometry ties the next keyscan to the previous one."""
        self.tracker.empty_buffer()
        self._recent.clear()
        self._begun_m = self.travel_m

    def recent_submap(self, until_s: float = math.inf) -> tuple[Submap, FloatArray]:
        """The submap of the last ``SUBMAP_REACH_M`` in the base of its newest keyscan, and ``T_local_base`` of that.

        Keyscans later than ``until_s``, seconds, are left out, as long as one is left.
        """
        keyscans = [keyscan for keyscan in self._recent if keyscan.record.stamp < until_s] or [self._recent[0]]
        anchor = keyscans[-1].T_local_base
        return build_submap([(k.points, se2.between(anchor, k.T_local_base)) for k in keyscans]), anchor

    def _is_keyscan(self, tracked: TrackedScan, laser: int) -> bool:
        if tracked.scan is None:
            return False
        if laser not in self._T_local_newest:
            return True
        x, y, turn = se2.motion(self._T_local_newest[laser], tracked.T_local_base)
        return math.hypot(x, y) >= self.config.keyscans.minimum_travel_distance_m or abs(turn) >= KEYSCAN_TURN_RAD

    def scan_pose(self, stamp: float, tracked: TrackedScan) -> ScanPose:
        """Pose of a localized scan relative to the newest keyscan, of which there is one after the first scan."""
        assert self._newest is not None  # the first scan is a keyscan
        return ScanPose(stamp, self._count - 1, se2.between(self._newest.T_local_base, tracked.T_local_base))

    def _add_keyscan(self, scan: LaserScan, tracked: TrackedScan, laser: int) -> MappedKeyscan:
        sweep = None if tracked.sweep is None else tracked.sweep.rounded()
        points = tracked.scan
        if points is None or sweep is not None:
            points = point_scan(scan.matched_ranges_m, scan.laser, sweep)
        self.tracker.insert(points, tracked.T_local_base, len(self.lasers))
        self._T_local_newest[laser] = tracked.T_local_base
        ranges_m, announced = _valid_ranges(scan.ranges_m, scan.laser.max_range_m), self.lasers[laser]
        beams = None if scan.laser == announced else scan.laser.beams
        record = Keyscan(KeyscanId(self.robot, self._count), scan.stamp, ranges_m, laser, beams, sweep)
        odometry, travel_m = self._odometry(tracked)
        T_odom_base = np.array(scan.T_odom_base)
        newest = MappedKeyscan(record, odometry, points, T_odom_base, tracked.T_local_base, travel_m)
        self._newest = newest
        self._count += 1
        self._recent.append(newest)
        while self._recent[0].travel_m < travel_m - SUBMAP_REACH_M:
            self._recent.popleft()
        return newest

    def _odometry(self, tracked: TrackedScan) -> tuple[Constraint | None, float]:
        if self._newest is None:
            return None, 0.0
        motion = se2.between(self._newest.T_local_base, tracked.T_local_base)
        constraint = Constraint(
            self.robot,
            self._count - 1,
            self._count,
            ConstraintKind.ODOMETRY,
            frozen(motion),
            frozen(motion_information(motion, tracked, self.odometry)),
        )
        progress = float(np.hypot(motion[0], motion[1])) + TURN_AS_TRAVEL_M * abs(float(motion[2]))
        return constraint, self._newest.travel_m + progress


def laser_index(known: list[LaserModel], laser: LaserModel) -> int:
    """Index of the laser of a scan among those of its robot, by its mounting and its beams; an unknown one is added.

    The beams of one laser may vary from scan to scan.
    """
    for index, other in enumerate(known):
        if is_same_laser(laser, other):
            return index
    known.append(laser)
    return len(known) - 1


def _tracker(config: LidarConfig, odometry: OdometryModel) -> ScanTracker:
    if config.tracker == "surfels":
        return ScanTracker(odometry)
    return KartoTracker(odometry, config.keyscans.minimum_travel_distance_m, KEYSCAN_TURN_RAD)


def motion_information(motion: FloatArray, tracked: TrackedScan, odometry: OdometryModel) -> FloatArray:
    """Information (3, 3) of the ``motion`` (3,) to a keyscan from the previous one, in the tangent space at the motion.

    The sum of the points' information and odometry's, limited by a floor of the standard deviations. The error of
    ``odometry`` counts if the scan was not matched or there are no wheels.
    """
    x, y, turn = motion.tolist()
    moved, turned = math.hypot(x, y), abs(turn)
    sigma_m = ODOMETRY_SIGMA_M + SIGMA_PER_TURN * moved
    sigma_rad = ODOMETRY_SIGMA_RAD + SIGMA_PER_TURN * turned
    share = POINT_INFORMATION_SHARE if odometry.is_measured else SCANS_ALONE_SHARE
    if not odometry.is_measured or not tracked.information.any():  # no wheels, or they may have slipped
        sigma_m, sigma_rad = odometry_error(moved, turned, odometry)
    floor_m, floor_rad = least_sigmas(moved, turned)
    return limited_information(
        share * tracked.information,
        float(tracked.T_local_base[2]),
        (sigma_m**-2, sigma_m**-2, sigma_rad**-2),
        (floor_m**2, floor_m**2, floor_rad**2),
    )


def least_sigmas(moved_m: float, turned_rad: float) -> tuple[float, float]:
    """Least standard deviations of the position (m) and heading (rad) between two consecutive keyscans."""
    return FLOOR_SIGMA_M + FLOOR_SHARE * moved_m, FLOOR_SIGMA_RAD + FLOOR_SHARE * turned_rad


def _valid_ranges(ranges_m: Ranges, max_range_m: float) -> Ranges:
    """Ranges of a keyscan, metres, inf for no return; invalid ones become 0."""
    valid = (ranges_m > 0.0) & (ranges_m < max_range_m) | np.isposinf(ranges_m)
    return frozen(np.where(valid, ranges_m, 0.0), np.float32)
