"""Length, duration and motion of a path, pose by pose: what every format's survey needs."""

from collections.abc import Iterable
from dataclasses import dataclass
from math import hypot, inf, isnan, remainder, tau
from typing import Final

from fcslam.sources.faults import FEWEST
from fcslam.sources.pose import Pose, relative_pose

RESOLUTION_M: Final = 1e-3
RESOLUTION_RAD: Final = 1e-4
"""Odometry that changes by less over a whole recording never changes."""
LEAST_TRAVEL_M: Final = 1.0
"""A robot that drove less far may not have turned at all."""
LONGEST_INTERVAL_S: Final = 0.35
"""Scans that come more seldom may show too little of the motion between them."""
SIDEWAYS: Final = 0.1
"""Odometry without turns that moves sideways by a larger share of its travel has no heading."""


@dataclass(slots=True)
class PathSummary:
    """Poses of one robot with their stamps, in file order."""

    count: int = 0
    length_m: float = 0.0
    """Length of the polyline through the positions."""
    moves: bool = False
    earliest: float = inf
    latest: float = -inf
    _first: Pose | None = None
    _pose: Pose | None = None
    _sideways_m: float = 0.0
    _leaves: bool = False
    _turns: bool = False

    def add(self, stamp: float, pose: Pose) -> None:
        """Append the next pose; ``stamp`` in seconds, ``pose`` in metres and radians."""
        if self._pose is None or self._first is None:
            self._first = pose
        elif pose != self._pose and not isnan(pose[0]):
            self.moves = True
            self.length_m += hypot(pose[0] - self._pose[0], pose[1] - self._pose[1])
            if not self.says_something:
                self._sideways_m += abs(relative_pose(self._pose, pose)[1])
                self._leaves |= hypot(pose[0] - self._first[0], pose[1] - self._first[1]) > RESOLUTION_M
                self._turns |= abs(remainder(pose[2] - self._first[2], tau)) > RESOLUTION_RAD
        self._pose = pose
        self.count += 1
        self.earliest = min(self.earliest, stamp)
        self.latest = max(self.latest, stamp)

    @property
    def duration_s(self) -> float:
        """Between the earliest and the latest stamp; 0 without poses."""
        return max(0.0, self.latest - self.earliest)

    @property
    def says_something(self) -> bool:
        """Whether the position and the heading change."""
        return self._leaves and self._turns

    @property
    def fault(self) -> str | None:
        """Why these poses are not odometry, as the end of a sentence; None if they can be."""
        if self.count < FEWEST or self.says_something:
            return None
        if not self._leaves and not self._turns:
            return f"never changes in {self.count} poses"
        if self._leaves and self.length_m > LEAST_TRAVEL_M and self._sideways_m > SIDEWAYS * self.length_m:
            return f"moves sideways for {self._sideways_m:.1f} of {self.length_m:.1f} m: its heading is never set"
        return None


def fault_of_odometry(poses: Iterable[Pose]) -> str | None:
    """``PathSummary.fault`` of poses in their order; reads as many as it needs."""
    summary = PathSummary()
    for pose in poses:
        summary.add(0.0, pose)
        if summary.says_something:
            return None
    return summary.fault if summary.count else "has no readable message"


def without_odometry(interval_s: float, has_gyro: bool = False) -> str:
    """The notice about a robot without odometry whose scans come at this interval, with or without a gyro."""
    said = "no odometry, so scan matching alone gives the motion"
    if has_gyro:
        said = "no odometry, so scan matching and the gyro give the motion"
    if interval_s > LONGEST_INTERVAL_S:
        said += f", and scans every {interval_s:.1g} s show too little of it: record them at 5 Hz or more, or odometry"
    return f"{said}; where the scans do not fix the position, as along a bare corridor, the distance is unknown"
