"""Jumps of a trajectory: steps between consecutive scans that no robot can make."""

from dataclasses import dataclass

import numpy as np

from fcslam.geometry import se2
from fcslam.records import FloatArray

LARGEST_SPEED_M_S = 3.0
LARGEST_TURN_RAD_S = 4.0
"""A faster step is a jump."""
SLACK_M = 0.2
"""Length allowed to any step, metres: the optimized map corrects by small steps."""
SLACK_RAD = 0.3
"""Turn allowed to any step, radians."""


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


def find_jumps(stamps: FloatArray, poses: FloatArray) -> Jumps | None:
    """The steps of a trajectory that are faster than a robot; None without any.

    ``stamps`` (N,) in seconds are of a clock that may step back; ``poses`` (N, 3), metres and radians.
    """
    if len(stamps) < 2:
        return None
    within_s = np.maximum(np.diff(stamps), 0.0)
    steps = se2.relative(poses)
    length_m, turn_rad = np.hypot(steps[:, 0], steps[:, 1]), np.abs(steps[:, 2])
    excess = np.maximum(
        length_m / (SLACK_M + LARGEST_SPEED_M_S * within_s + 1e-9),
        turn_rad / (SLACK_RAD + LARGEST_TURN_RAD_S * within_s + 1e-9),
    )
    count = int(np.count_nonzero(excess > 1.0))
    if not count:
        return None
    k = int(np.argmax(excess))
    return Jumps(count, float(length_m[k]), float(turn_rad[k]), float(within_s[k]), float(stamps[k + 1]))
