"""Closures that users make by hand: the walls that both ends saw refine them."""

from collections.abc import Sequence

import numpy as np

from fcslam.geometry import se2
from fcslam.lidar.scan import PointScan
from fcslam.lidar.submap import build_submap
from fcslam.lidar.verification import VERIFICATION, verify
from fcslam.records import FloatArray, ManualClosure

MOST_SIGMAS = 3.0
"""Walls that fit only farther off than this many standard deviations of the user's pose show another place."""

Scans = Sequence[tuple[PointScan, FloatArray]]
"""Scans around a keyscan, and their poses (3,) in its base."""


def measured(made: ManualClosure, i: Scans, j: Scans) -> tuple[FloatArray, FloatArray]:
    """Pose of j in i (3,) and its information (3, 3), as the walls around both ends refine them.

    They are as the user gave them if the ends see too little in common, or fit only outside the user's tolerance.
    """
    metres, radians = made.tolerance
    guess, information = np.array(made.T_i_j), np.diag([1.0 / metres**2, 1.0 / metres**2, 1.0 / radians**2])
    if not all(any(len(scan.points) for scan, _ in scans) for scans in (i, j)):
        return guess, information
    found = verify(build_submap(i), build_submap(j), guess, VERIFICATION, information)
    off = np.abs(se2.between(guess, found.T_a_b))
    fits = found.loose and np.hypot(off[0], off[1]) <= MOST_SIGMAS * metres and off[2] <= MOST_SIGMAS * radians
    return (found.T_a_b, found.information) if fits else (guess, information)
