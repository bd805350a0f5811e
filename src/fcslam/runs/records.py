"""Records of a run. Arrays in them are read-only."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from fcslam.maps.occupancy_map import OccupancyMap, parse_map
from fcslam.records import Channel, ClosureStatus, FloatArray, Reason, frozen


@dataclass(frozen=True, slots=True, eq=False)
class RobotTrajectory:
    """Where one robot was at every laser scan of its recording, in the order of the scans."""

    robot: str
    """Name of the robot, or of one of its sessions: ``robot1``, ``robot1+1`` ..."""
    map_index: int
    """Key of the robot's map in ``Run.maps``."""
    stamps: FloatArray
    """Shape (N,), seconds of the recording's own clock."""
    T_map_base: FloatArray
    """Poses (x, y, theta) of ``base`` in the coordinate frame of the robot's map, metres and radians, shape (N, 3)."""
    floor: str = ""
    """Floor that the session named; empty: none."""
    T_map_base_6d: FloatArray | None = None
    """The same poses with six degrees of freedom, (x, y, z, qx, qy, qz, qw), shape (N, 7); None: of a map in 2D."""

    @property
    def poses(self) -> FloatArray:
        """The poses with all degrees of freedom that the map has, shape (N, 3) or (N, 7)."""
        return self.T_map_base if self.T_map_base_6d is None else self.T_map_base_6d

    def nearest(self, stamp: float) -> int:
        """Row of the scan whose stamp is nearest; there is at least one scan."""
        return int(np.argmin(np.abs(self.stamps - stamp)))

    @property
    def path_length_m(self) -> float:
        """Length of the polygon through the positions."""
        steps = np.diff(self.T_map_base[:, :2], axis=0)
        return float(np.sum(np.hypot(steps[:, 0], steps[:, 1])))


@dataclass(frozen=True, slots=True, eq=False)
class LocalizedPoses:
    """Poses of one robot in a finished map, at every laser scan of its recording."""

    robot: str
    stamps: FloatArray
    """Shape (N,), seconds of the recording's own clock."""
    T_map_base: FloatArray
    """Poses (x, y, theta) of ``base``, metres and radians, shape (N, 3); NaN where the robot was not localized."""
    sigma: FloatArray
    """Standard deviations of x, y (m) and theta (rad), shape (N, 3); NaN where the robot was not localized."""
    quality: FloatArray
    """Share of the walls that lie on walls of the map, where the map knows the area, shape (N,); 0 where the robot was
    not localized. It is the smaller of two shares: of the last metres and of the newest keyscan.
    """
    T_map_base_6d: FloatArray | None = None
    """As in ``RobotTrajectory``; the CSV file has none."""

    @property
    def is_localized(self) -> NDArray[np.bool_]:
        """Whether the robot had a pose, shape (N,)."""
        return ~np.isnan(self.T_map_base[:, 0])

    def believed(self) -> RobotTrajectory:
        """The scans at which the robot had a pose, in map 0."""
        known = self.is_localized
        in_space: FloatArray | None = None if self.T_map_base_6d is None else frozen(self.T_map_base_6d[known])
        stamps: FloatArray = frozen(self.stamps[known])
        poses: FloatArray = frozen(self.T_map_base[known])
        return RobotTrajectory(self.robot, 0, stamps, poses, T_map_base_6d=in_space)


@dataclass(frozen=True, slots=True, eq=False)
class LocalMap:
    """One robot's own map, made from its own measurements alone; the origin is its first keyscan."""

    robot: str
    stamps: FloatArray
    """Shape (N,), as in the robot's trajectory."""
    T_local_base: FloatArray
    """Poses (x, y, theta) of ``base`` in the robot's own map at every laser scan, shape (N, 3)."""
    pgm: bytes
    yaml: str
    """For ROS map_server; names the PGM file ``<robot>.pgm``."""

    def occupancy(self) -> OccupancyMap:
        """The robot's own occupancy map."""
        return parse_map(f"the own map of {self.robot}", self.pgm, self.yaml)


@dataclass(frozen=True, slots=True, eq=False)
class ClosureRow:
    """One loop closure: the claim that two keyscans saw the same place. A line of closures.csv."""

    robot_i: str
    stamp_i: float
    """Stamp of the keyscan of ``robot_i``, seconds."""
    robot_j: str
    stamp_j: float
    channel: Channel
    similarity: float
    """In [0, 1]."""
    T_i_j: FloatArray
    """Measured pose (x, y, theta) of base j in base i, metres and radians, shape (3,)."""
    status: ClosureStatus
    reason: Reason
    """Why the closure has this status."""


@dataclass(frozen=True, slots=True)
class Join:
    """On what evidence two robots share a map. A line of joins.csv."""

    robot_i: str
    robot_j: str
    closures: int
    """Closures between them that agree."""
    places: int
    """Separate places of these closures."""
    seen_m: float
    """Wall that both robots saw, metres; NaN if the maps were not compared."""
    contradicting_m: float
    """Share of the compared walls in the other's free space, times ``seen_m``, metres."""
    likeness: float
    """How well the walls lie on each other: about 1 in one place, mostly below 0.5 in places that only look alike."""
    elsewhere: float
    """How well the maps fit at the best other transform, as a share; 0 if they fit nowhere else."""

    def __str__(self) -> str:
        """One line for users."""
        places = f"{self.places} place{'' if self.places == 1 else 's'}"
        what = f"{self.robot_i} and {self.robot_j}: {self.closures} closures from {places}"
        if math.isnan(self.seen_m):
            return f"{what}; their maps could not be compared"
        share = 100.0 * self.contradicting_m / self.seen_m if self.seen_m else 0.0
        seen = (
            f"{what}; {self.seen_m:.0f} m of wall seen by both, {self.contradicting_m:.1f} m ({share:.1f} %) contradict"
        )
        return seen + (f"; elsewhere the maps fit {self.elsewhere:.2f} times as well" if self.elsewhere > 0.0 else "")


@dataclass(frozen=True, slots=True)
class Metric:
    """A named number with its unit."""

    name: str
    value: float
    """NaN: there is nothing to measure."""
    unit: str
    """``1`` for counts and ratios."""


@dataclass(frozen=True, eq=False)
class RunTables:
    """The tables of a run."""

    trajectories: Mapping[str, RobotTrajectory]
    """By robot."""
    closures: tuple[ClosureRow, ...] = ()
    """Every loop closure considered between robots and every one within a robot, with its status and the reason."""
    joins: tuple[Join, ...] = ()
    """On what evidence robots share a map, for each two with closures between them that agree."""
    metrics: Mapping[str, Metric] = field(default_factory=dict)
    """By name."""
    config_yaml: str = ""
    """The complete configuration."""
