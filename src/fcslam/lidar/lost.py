"""Detection of a lost robot: its newest scans are compared with its newest keyscans.

A robot that was picked up, or whose odometry failed, sees another place than its last keyscans did. A single scan that
explains little may come from a crowd or an opened door. So doubtful scans are deferred until they are enough for a
submap of their own; two submaps that contradict each other show two places. A robot that leaves a closed cabin may be
on another floor, where much looks alike: all its scans from the opening of the door on are deferred.

Without odometry, nothing shows the motion in a gap of the scans. The robot is lost unless the scans after it fit the
map in one way only, or agree with it where they were matched.

The newest keyscans may contradict the scans although the robot drove on, as after a match to the ground. Then the scan
before and one of the doubtful ones show one place, where odometry says: only another local map is needed.
"""

import math
from collections.abc import Mapping, Sequence

import numpy as np
from pydantic import Field

from fcslam.config import Settings
from fcslam.geometry import se2
from fcslam.lidar.closing import CONCLUSIVE_OVERLAP
from fcslam.lidar.evidence import CLEAR, CORRELATED, LEAST_KNOWN
from fcslam.lidar.field import SurfelField
from fcslam.lidar.first_motion import LONGEST_GAP_S
from fcslam.lidar.frontend import LidarFrontend
from fcslam.lidar.matching import match_scan
from fcslam.lidar.odometry import FIRST_MATCHES, OdometryModel, OdometryTrust, odometry_error
from fcslam.lidar.scan import point_scan
from fcslam.lidar.submap import Agreement
from fcslam.lidar.tracker import POINT_LIMIT, POINT_SPACING_M, SUPPORTED, TrackingResult
from fcslam.lidar.verification import LOOSE, verify
from fcslam.records import CloudScan, FloatArray, LaserScan

DOUBTFUL_TRAVEL_M = 1.0
"""Least travel over consecutive doubtful scans before they are compared, metres."""
FEWEST_SCANS = 5
"""Least number of consecutive doubtful scans before they are compared."""
MOST_SCANS = 100
"""Number of consecutive doubtful scans that are compared even without ``DOUBTFUL_TRAVEL_M`` of travel."""
SETTLED_M = 3.0
"""Travel that a session must have mapped before its robot can be lost, metres."""
AGREEING = 0.90
"""Least median share of points that the doubtful scans explain of each other; below it, nothing is decided."""
LOST_EXPLAINED = 0.60
"""A lost robot sees a smaller share of its points in known area on a surface; two scans of one place, a larger one."""
LOST_VIOLATION = 0.30
"""A lost robot sees a larger share of its points in known area in free space."""
RODE = 0.73
"""A robot that leaves a closed cabin on another floor sees a smaller share on a surface, less the share in free space.
The cabin says where its door is, so a part of the walls decides; but more of them lie in known area."""
LEAST_OVERLAP = LOOSE.overlap
"""Least share of all points in known area; below it, nothing is decided."""
STAYED_M, LARGEST_SPEED, REACHABLE_S = 1.0, 2.0, 5.0
"""Without odometry, the search for a robot has this radius, metres, which grows with a gap in the scans, m/s. After a
longer gap, seconds, it might find another room with the same walls: the robot must be where it was."""
SEEN_S = 2.0 * LONGEST_GAP_S
"""After a shorter gap, in seconds, a robot that is found nowhere counts as where it was: a match finds it again."""
GAP_TRAVEL_M = 2.0 * DOUBTFUL_TRAVEL_M
"""``DOUBTFUL_TRAVEL_M`` after a gap, metres: more walls fit in fewer ways."""
LEAST_RATIO, LEAST_RIVAL_M, LARGEST_VIOLATION = 1.5, 5.0, 0.12
"""The best alignment after a gap scores higher than the best one elsewhere by this factor. The one elsewhere counts as
so many metres at least: a few walls are never unique. At most this share of the walls lies in free space."""
LARGEST_STEP_M = 15.0
"""A robot that moved farther than this, in metres, between two scans is lost: nobody saw the way."""


class LostConfig(Settings):
    """When a robot is lost and starts a new session."""

    doubted: float = Field(
        default=CLEAR,
        ge=0,
        le=1,
        description="a scan is doubtful if a smaller share of its points in known area lies on a surface; "
        "0 disables the detection",
    )


def has_moved_unseen(before: LaserScan | CloudScan, now: LaserScan | CloudScan) -> bool:
    """Whether a robot moved so far between two scans that odometry alone must not tie their places together."""
    x, y, _ = se2.motion(before.T_odom_base, now.T_odom_base)
    return math.hypot(x, y) > LARGEST_STEP_M


def is_doubtful(
    tracking: TrackingResult, frontend: LidarFrontend, config: LostConfig, is_leaving: bool = False
) -> bool:
    """Whether a scan may show another place than the scans before it.

    So may a scan without odometry that was not accepted, and all scans while the robot leaves a closed cabin.
    """
    if frontend.settled_m < SETTLED_M or not config.doubted:
        return False
    # Both are false for a scan that was not matched, as its shares are NaN.
    is_rejected = not frontend.odometry.is_measured and tracking.explained < SUPPORTED
    return is_leaving or is_rejected or tracking.explained < config.doubted * tracking.known


def can_decide(scans: Sequence[LaserScan], travel_m: float = DOUBTFUL_TRAVEL_M, most: int = MOST_SCANS) -> bool:
    """Whether these consecutive doubtful scans are enough for a decision, by the least travel over them in metres.

    ``most`` scans are enough without it.
    """
    steps = se2.relative(np.array([scan.T_odom_base for scan in scans]))
    far = len(scans) >= FEWEST_SCANS and np.hypot(steps[:, 0], steps[:, 1]).sum() >= travel_m
    return bool(far) or len(scans) >= most


def is_lost(scans: Sequence[LaserScan], frontend: LidarFrontend, closed_s: float | None = None) -> bool:
    """Whether consecutive scans that the front end has deferred show another place than its newest keyscans.

    ``closed_s`` is the stamp at which the door of the cabin that the robot leaves closed, seconds; None: no cabin.
    """
    fresh = frontend.fresh()
    if not _are_consistent(scans, fresh):
        return False
    T_local_first = frontend.localize(scans[0]).tracked.T_local_base
    worse = _agreement_at(T_local_first, frontend, fresh, math.inf if closed_s is None else closed_s)
    if closed_s is not None:
        return worse.overlap >= CONCLUSIVE_OVERLAP and worse.explained - worse.violation < RODE
    return worse.overlap >= LEAST_OVERLAP and worse.explained < LOST_EXPLAINED and worse.violation > LOST_VIOLATION


def is_unplaced(scan: LaserScan, frontend: LidarFrontend) -> bool:
    """Whether neither odometry nor the map says where a scan is."""
    return not frontend.odometry.is_measured and not frontend.localize(scan).tracked.information.any()


def relocated(scans: Sequence[LaserScan], frontend: LidarFrontend) -> FloatArray | None:
    """Where deferred scans are among the newest keyscans of the front end, wherever they were predicted.

    The pose (3,) of the first of them in the local frame of the tracker: where they fit clearly best, or else where
    they were predicted if they agree with the keyscans there. None: neither.
    """
    from fcslam.lidar.uniqueness import best_alignment  # SciPy's transforms take long to load, and few robots need them

    fresh = frontend.fresh()
    if not _are_consistent(scans, fresh):
        return None
    (before, T_local_before), (now, T_first_now) = frontend.recent_submap(), fresh.recent_submap()
    found = best_alignment(before, now, LEAST_RIVAL_M)
    if found is None:
        return None
    best, ratio = found
    if ratio >= LEAST_RATIO and best.violation <= LARGEST_VIOLATION:
        return se2.compose(se2.compose(T_local_before, best.T_a_b), se2.inverse(T_first_now))
    T_local_first = frontend.localize(scans[0]).tracked.T_local_base
    worse = _agreement_at(T_local_first, frontend, fresh)
    agrees = worse.explained >= LOOSE.explained and worse.violation <= LOOSE.violation
    agrees &= worse.overlap >= LOOSE.overlap
    return T_local_first if agrees else None


def _agreement_at(
    T_local_first: FloatArray, frontend: LidarFrontend, fresh: LidarFrontend, until_s: float = math.inf
) -> Agreement:
    """How well the deferred scans in ``fresh``, whose first one begins at a pose (3,), agree with the newest keyscans.

    Keyscans later than ``until_s``, seconds, are left out.
    """
    (before, T_local_before), (now, T_first_now) = frontend.recent_submap(until_s), fresh.recent_submap()
    predicted = se2.between(T_local_before, se2.compose(T_local_first, T_first_now))
    return verify(before, now, predicted).worse


def is_in_reach(T_local_base: FloatArray, scan: LaserScan, frontend: LidarFrontend, gap_s: float) -> bool:
    """Whether a robot without odometry may have come to a pose, shape (3,), in a gap of the scans before ``scan``."""
    x, y, _ = se2.motion(frontend.localize(scan).tracked.T_local_base, T_local_base)
    reach_m = STAYED_M + LARGEST_SPEED * (gap_s if gap_s <= REACHABLE_S else 0.0)
    return math.hypot(x, y) <= reach_m


def drove_on(
    before: Mapping[tuple[float, float, float], LaserScan],
    scans: Sequence[LaserScan],
    odometry: OdometryModel,
    trust: OdometryTrust,
) -> bool:
    """Whether trusted odometry and the scans themselves agree that a robot drove from the last scans to doubtful ones.

    One pair of scans is enough: on a bump, a scan or two show only the ground. ``before`` is the last scan of each
    laser, by its mounting; the error of odometry is that of the model and as learned.
    """
    # The constraint over the gap has the error by the model, of scale 1.
    is_trusted = trust.matches >= FIRST_MATCHES and max(trust.position, trust.heading) <= 1.0
    if not is_trusted or not odometry.is_measured:
        return False
    for now in scans:
        last = before.get(now.laser.T_base_laser)
        if last is None or last.laser != now.laser:
            continue
        x, y, turn = motion = trust.motion(se2.motion(last.T_odom_base, now.T_odom_base))
        error = trust.scale(odometry_error(math.hypot(x, y), abs(float(turn)), odometry))
        field = SurfelField(np.zeros(3))
        field.insert(point_scan(last.matched_ranges_m, last.laser, last.sweep), np.zeros(3))
        scan = point_scan(now.matched_ranges_m, now.laser, now.sweep).thinned(POINT_SPACING_M, POINT_LIMIT)
        match = match_scan(scan, field, np.array(motion), CORRELATED * error.information)
        if match.known >= LEAST_KNOWN and match.explained >= LOST_EXPLAINED * match.known:
            return True
    return False


def _are_consistent(scans: Sequence[LaserScan], fresh: LidarFrontend) -> bool:
    """Track the scans with a fresh front end; whether they explain one another. Otherwise nothing can be decided."""
    shares = []
    for scan in scans:
        tracking = fresh.localize(scan)
        fresh.process(scan, tracking)
        if tracking.known > 0.0:  # not so for a scan that was not matched
            shares.append(tracking.explained / tracking.known)
    return bool(shares) and bool(np.median(shares) >= AGREEING)
