"""Information of a motion that points measure: with a prior, and limited by errors that more points do not reduce."""

import numpy as np

from fcslam.compiled import njit
from fcslam.lidar.matching import solve
from fcslam.records import FloatArray

Diagonal = tuple[float, float, float]
"""Diagonal elements over (x, y, theta)."""


def limited_information(points: FloatArray, heading_rad: float, prior: Diagonal, variance: Diagonal) -> FloatArray:
    """``((R' P R + diag(prior))^-1 + diag(variance))^-1``, shape (3, 3), over (x, y, theta) of the robot.

    ``points`` P is over (x, y) in a field and theta; writable, as code is compiled once. R is the robot's heading
    there. The ``prior`` is positive, and ``variance`` the least one.
    """
    information: FloatArray = _limited(points, heading_rad, prior, variance)
    return information


@njit
def _limited(points, heading, prior, variance):  # type: ignore[no-untyped-def]
    cos, sin = np.cos(heading), np.sin(heading)
    sum_, inverse = np.empty((3, 3)), np.empty((3, 3))
    for c in range(3):  # R' P
        inverse[0, c] = cos * points[0, c] + sin * points[1, c]
        inverse[1, c] = cos * points[1, c] - sin * points[0, c]
        inverse[2, c] = points[2, c]
    for r in range(3):
        sum_[r, 0] = cos * inverse[r, 0] + sin * inverse[r, 1]
        sum_[r, 1] = cos * inverse[r, 1] - sin * inverse[r, 0]
        sum_[r, 2] = inverse[r, 2]
        sum_[r, r] += prior[r]
    _invert(sum_, inverse)
    for r in range(3):
        inverse[r, r] += variance[r]
    _invert(inverse, sum_)
    return 0.5 * (sum_ + sum_.T)


@njit
def _invert(matrix, inverse):  # type: ignore[no-untyped-def]
    unit = np.zeros(3)
    for c in range(3):
        unit[c] = 1.0
        inverse[0, c], inverse[1, c], inverse[2, c] = solve(matrix, unit)
        unit[c] = 0.0
