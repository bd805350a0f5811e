"""Length, duration and motion of a path, pose by pose: what every format's survey needs."""

from cmath import rect
from collections.abc import Iterable
from dataclasses import dataclass
from math import atan2, hypot, inf, radians, remainder, tau
from pathlib import Path
from typing import Final

from fcslam.errors import SourceError
from fcslam.sources.pose import Pose, relative_pose

RESOLUTION_M: Final = 1e-3
RESOLUTION_RAD: Final = 1e-4
"""Odometry that changes by less over a whole recording never changes."""
FEWEST_POSES: Final = 10
"""Fewer poses are not judged."""
LEAST_TRAVEL_M: Final = 1.0
"""A robot that drove less far may not have turned at all."""
SIDEWAYS: Final = 0.1
"""Odometry without turns that moves sideways by a larger share of its travel has no heading."""
FASTEST_M_S: Final = 10.0
"""Larger speeds are those of no robot that maps a building."""
LONG_STEP_M: Final = 0.02
"""Shorter steps may be noise of a robot at rest."""
ZIGZAG: Final = 0.2
"""Share of the long steps that go back, of poses of two nodes; a robot rarely turns back."""
LEAST_DURATION_S: Final = 10.0
"""The stamps of a shorter drive may all be wrong."""
TURN_RAD: Final = 0.05
"""Smaller turns between two poses may be noise."""
FASTEST_RAD_S, LARGEST_MEAN_RAD_S = 10.0, 2.0
"""Speeds of a turn, at once and over a whole drive, of no robot that maps a building."""
CHORD_M: Final = 0.1
"""Length of the pieces of a path whose directions are compared with the headings."""
FEWEST_CHORDS: Final = 50
"""Fewer say nothing about headings."""
AGREES, DISAGREES = 0.9, 0.7
"""Agreement of the directions, 0 to 1, with headings that are right, and that are not."""


@dataclass(slots=True)
class PathSummary:
    """Poses of one robot with their stamps, in file order."""

    count: int = 0
    length_m: float = 0.0
    """Length of the polyline through the positions."""
    moves: bool = False
    """Whether any two successive poses differ."""
    earliest: float = inf
    latest: float = -inf
    _steps: int = 0
    """Steps of known duration to another position."""
    _fast: int = 0
    """Those faster than any robot."""
    _turned_rad: float = 0.0
    """By all turns, in steps of known duration."""
    _turned: int = 0
    """Steps with a turn larger than noise."""
    _spun: int = 0
    """Those faster than any robot."""
    _long: int = 0
    """Those longer than noise."""
    _back: int = 0
    """Long ones against the direction of the one before."""
    _direction: tuple[float, float] = (0.0, 0.0)
    _stamp: float = 0.0
    _first: Pose | None = None
    _pose: Pose | None = None
    _sideways_m: float = 0.0
    _leaves: bool = False
    _turns: bool = False
    _largest: float = 0.0
    """Heading."""
    _chord: Pose | None = None
    """Where the newest piece of the path begins."""
    _chords: int = 0
    _fixed: complex = 0.0
    _in_radians: complex = 0.0
    _in_degrees: complex = 0.0
    """Sums of the directions of the pieces, forward and backward alike, against a fixed heading and against theirs."""

    def add(self, stamp: float, pose: Pose) -> None:
        """Append the next pose; ``stamp`` in seconds, ``pose`` in metres and radians."""
        if self._pose is None or self._first is None:
            self._first = pose
        elif pose != self._pose:
            self.moves = True
            x, y = pose[0] - self._pose[0], pose[1] - self._pose[1]
            step_m = hypot(x, y)
            self.length_m += step_m
            if stamp > self._stamp:
                turned_rad = abs(remainder(pose[2] - self._pose[2], tau))
                self._turned_rad += turned_rad
                self._turned += turned_rad > TURN_RAD
                self._spun += turned_rad > max(TURN_RAD, FASTEST_RAD_S * (stamp - self._stamp))
                self._steps += 1
                self._fast += step_m > FASTEST_M_S * (stamp - self._stamp)
                if step_m > LONG_STEP_M:
                    self._long += 1
                    self._back += x * self._direction[0] + y * self._direction[1] < 0.0
                    self._direction = x, y
            if not self.says_something:
                self._sideways_m += abs(relative_pose(self._pose, pose)[1])
                self._leaves |= hypot(pose[0] - self._first[0], pose[1] - self._first[1]) > RESOLUTION_M
                self._turns |= abs(remainder(pose[2] - self._first[2], tau)) > RESOLUTION_RAD
        self._pose, self._stamp = pose, stamp
        self._compare_heading(pose)
        self.count += 1
        self.earliest = min(self.earliest, stamp)
        self.latest = max(self.latest, stamp)

    def _compare_heading(self, pose: Pose) -> None:
        self._largest = max(self._largest, abs(pose[2]))
        x, y, theta = self._chord = self._chord or pose
        ahead, left = pose[0] - x, pose[1] - y
        if hypot(ahead, left) < CHORD_M:
            return
        way, self._chord, self._chords = atan2(left, ahead), pose, self._chords + 1
        self._fixed += rect(1.0, 2.0 * way)
        self._in_radians += rect(1.0, 2.0 * way - 2.0 * theta - remainder(pose[2] - theta, tau))
        self._in_degrees += rect(1.0, 2.0 * way - radians(2.0 * theta + remainder(pose[2] - theta, 360.0)))

    @property
    def is_in_degrees(self) -> bool:
        """Whether the robot drives where its headings point if they are degrees, and only then."""
        if self._chords < FEWEST_CHORDS or self._largest < tau:
            return False
        wrong = max(abs(self._fixed), abs(self._in_radians))
        return wrong < DISAGREES * self._chords and abs(self._in_degrees) > AGREES * self._chords

    @property
    def duration_s(self) -> float:
        """Between the earliest and the latest stamp; 0 without poses."""
        return max(0.0, self.latest - self.earliest)

    @property
    def says_something(self) -> bool:
        """Whether the position and the heading change."""
        return self._leaves and self._turns

    @property
    def is_too_fast(self) -> bool:
        """Whether the whole drive and most of its steps are faster than any robot; a jump alone does not count."""
        is_fast = self.duration_s >= LEAST_DURATION_S and self.length_m > FASTEST_M_S * self.duration_s
        return is_fast and 2 * self._fast > self._steps

    @property
    def spins(self) -> str | None:
        """How the robot turns if that is faster than any, as the end of a sentence."""
        is_fast = self.duration_s >= LEAST_DURATION_S and self._turned_rad >= LARGEST_MEAN_RAD_S * self.duration_s
        if not is_fast or 3 * self._spun <= 2 * self._turned:
            return None
        return f"turns {self._turned_rad:.0f} rad in {self.duration_s:.0f} s"

    @property
    def zigzag(self) -> str | None:
        """What these poses do if two nodes publish them, as the end of a sentence; None if they are of one."""
        if self._back < FEWEST_POSES or self._back < ZIGZAG * self._long:
            return None
        return f"goes back and forth at {self._back} of {self._long} steps, as if two nodes published it"

    @property
    def fault(self) -> str | None:
        """Why these poses are not odometry, as the end of a sentence; None if they can be."""
        if self.count < FEWEST_POSES or self.says_something:
            return None
        if not self._leaves and not self._turns:
            return f"never changes in {self.count} poses"
        if self._leaves and self.length_m > LEAST_TRAVEL_M and self._sideways_m > SIDEWAYS * self.length_m:
            return f"moves sideways for {self._sideways_m:.1f} of {self.length_m:.1f} m: its heading is never set"
        return None


def check_units(path: Path, driven: PathSummary) -> None:
    """Reject odometry in millimetres, centimetres or degrees."""
    if driven.is_in_degrees:
        raise SourceError(
            f"{path}: the headings of the odometry are in degrees, as the robot drives where they then point; convert "
            "them to radians"
        )
    if driven.is_too_fast:
        raise SourceError(
            f"{path}: the odometry drives {driven.length_m:.0f} m in {driven.duration_s:.0f} s, as if in millimetres "
            "or centimetres, or of two robots; correct it to metres, or map a bag without it by --sensors "
            "odom-topic=none"
        )


def fault_of_odometry(poses: Iterable[Pose]) -> str | None:
    """``PathSummary.fault`` of poses in their order; reads as many as it needs."""
    summary = PathSummary()
    for pose in poses:
        summary.add(0.0, pose)
        if summary.says_something:
            return None
    return summary.fault if summary.count else "has no readable message"


WITHOUT_ODOMETRY: Final = (
    "no odometry, so scan matching alone gives the motion; where the scans do not fix the position, as along a bare "
    "corridor, the distance is unknown"
)
"""A note about such a recording."""
