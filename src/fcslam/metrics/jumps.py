"""Jumps of a trajectory: steps between consecutive scans that no robot can make."""

from dataclasses import dataclass

import numpy as np
from pydantic import Field

from fcslam.config import Settings
from fcslam.geometry import se2
from fcslam.records import FloatArray

SLACK_M = 0.2
"""Length allowed to any step, metres: the optimized map corrects by small steps."""
SLACK_RAD = 0.3
"""Turn allowed to any step, radians."""


class JumpLimits(Settings):
    """The fastest motion that a trajectory may have; a faster step is a jump."""

    speed_m_s: float = Field(default=3.0, gt=0, description="largest speed [m/s]")
    turn_rad_s: float = Field(default=4.0, gt=0, description="largest speed of a turn [rad/s]")


@dataclass(frozen=True, slots=True)
class Jumps:
    """The jumps of one trajectory."""

    count: int
    largest_m: float
    """Length of the jump that exceeds the limits most, metres."""
    largest_rad: float
    """Its turn, radians."""
    within_s: float
    """Time between its two scans, seconds."""
    stamp: float
    """Stamp of the scan after it, seconds."""

    def __str__(self) -> str:
        jumps = "1 jump" if self.count == 1 else f"{self.count} jumps, the largest"
        turn_deg = np.degrees(self.largest_rad)
        size = f"{self.largest_m:.2f} m and {turn_deg:.0f} deg"
        return f"{jumps} of {size} within {self.within_s:.2f} s at {self.stamp:.3f} s"


def find_jumps(stamps: FloatArray, poses: FloatArray, limits: JumpLimits) -> Jumps | None:
    """The steps of a trajectory that exceed the limits of motion; None without any.

    ``stamps`` (N,) in seconds are of a clock that may step back; ``poses`` (N, 3), metres and radians.
    """
    if len(stamps) < 2:
        return None
    within_s = np.maximum(np.diff(stamps), 0.0)
    steps = se2.relative(poses)
    length_m, turn_rad = np.hypot(steps[:, 0], steps[:, 1]), np.abs(steps[:, 2])
    excess = np.maximum(
        length_m / (SLACK_M + limits.speed_m_s * within_s + 1e-9),
        turn_rad / (SLACK_RAD + limits.turn_rad_s * within_s + 1e-9),
    )
    count = int(np.count_nonzero(excess > 1.0))
    if not count:
        return None
    k = int(np.argmax(excess))
    return Jumps(count, float(length_m[k]), float(turn_rad[k]), float(within_s[k]), float(stamps[k + 1]))
