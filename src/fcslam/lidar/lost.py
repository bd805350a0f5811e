"""Is the robot still where it thinks it is? What it sees now is compared with what it saw just before.

A robot that was picked up and put down elsewhere, or whose odometry broke, sees another place than the one around its
last keyscans. One scan that explains little of the known area may be a crowd or a door; so scans are put by until they
are enough for a submap of their own, and two submaps that contradict each other are two places.
"""

from collections.abc import Sequence

import numpy as np
from pydantic import Field

from fcslam.config import Settings
from fcslam.geometry import se2
from fcslam.lidar.mapper import Mapper
from fcslam.lidar.tracker import TrackingResult
from fcslam.lidar.verification import verify
from fcslam.records import FloatArray, LaserScan


class LostConfig(Settings):
    """When a robot is lost and begins a new session."""

    doubted: float = Field(
        default=0.8, ge=0, le=1, description="a scan that explains less of the known area is put by; 0: never lost"
    )
    travel_m: float = Field(default=1.0, ge=0, description="travel over which scans in a row have to be doubted")
    fewest_scans: int = Field(default=5, ge=1, description="and how many at least")
    most_scans: int = Field(default=100, ge=1, description="with so many it is decided, however short the way")
    settled_m: float = Field(default=3.0, ge=0, description="who has mapped less of a way cannot be lost")
    agreeing: float = Field(
        default=0.90, ge=0, le=1, description="scans put by tell nothing where they explain less of each other (median)"
    )
    explained: float = Field(
        default=0.60, ge=0, le=1, description="lost: of the points in known area fewer lie on a surface"
    )
    violation: float = Field(default=0.30, ge=0, le=1, description="and more of them in free space")
    overlap: float = Field(default=0.25, ge=0, le=1, description="least share of points in known area to tell")


def is_doubtful(tracking: TrackingResult, mapper: Mapper, config: LostConfig) -> bool:
    """Whether a scan seems to show another place than the scans before it."""
    # False for a scan that was not matched, as both are NaN.
    return mapper.travel_m >= config.settled_m and tracking.explained < config.doubted * tracking.known


def is_enough(scans: Sequence[LaserScan], config: LostConfig) -> bool:
    """Whether so many doubtful scans in a row can be decided."""
    steps = se2.relative(np.array([scan.T_odom_base for scan in scans]))
    far = len(scans) >= config.fewest_scans and np.hypot(steps[:, 0], steps[:, 1]).sum() >= config.travel_m
    return bool(far) or len(scans) >= config.most_scans


def is_lost(scans: Sequence[LaserScan], T_local_first: FloatArray, mapper: Mapper, config: LostConfig) -> bool:
    """Whether scans that the mapper has not processed show another place than its newest keyscans.

    Args:
        scans: in a row.
        T_local_first: where the first of them was taken, as the mapper's tracker sees it, shape (3,).
        mapper: of the robot.
        config: what tells two places apart.
    """
    anew = Mapper(mapper.robot, mapper.config)
    if not _agree(scans, anew, config):
        return False
    (seen, T_local_seen), (now, T_first_now) = mapper.recent_submap(), anew.recent_submap()
    predicted = se2.between(T_local_seen, se2.compose(T_local_first, T_first_now))
    worse = verify(seen, now, predicted, mapper.config.verification).worse
    return worse.overlap >= config.overlap and worse.explained < config.explained and worse.violation > config.violation


def _agree(scans: Sequence[LaserScan], anew: Mapper, config: LostConfig) -> bool:
    """Whether scans explain one another, mapped anew: where even they do not, nothing can be told from the rest."""
    shares = []
    for scan in scans:
        tracking = anew.localize(scan)
        anew.process(scan, tracking)
        if tracking.known > 0.0:  # not so for a scan that was not matched
            shares.append(tracking.explained / tracking.known)
    return bool(shares) and bool(np.median(shares) >= config.agreeing)
