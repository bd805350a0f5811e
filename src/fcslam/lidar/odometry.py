"""Error of the wheel odometry: a model for every robot, and how far this robot's odometry can be trusted.

A good match measures how far odometry was wrong. These innovations, relative to the model, give the robot its own scale
of the error. Slips are outliers: the error follows a Student t distribution, whose scale is learned robustly.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from fcslam.geometry.se2 import Pose
from fcslam.records import FloatArray

TAIL: float = 1.0
"""Degrees of freedom of the Student t distribution of the error; few, as wheels may slip."""
FIRST_MATCHES = 20
LATEST_MATCHES = 10 * FIRST_MATCHES
"""The model counts as many matches as the first number; later matches replace the oldest of the second number."""
FIRST_TRUST = 0.5
"""Learned scale before the first match: most robots' odometry is better than the model."""
LEAST_TRUST = 0.1
"""Least learned scale: matches have an error of their own."""


@dataclass(frozen=True, slots=True)
class OdometryModel:
    """Error of the wheel odometry since the last match, as the sum of a constant, a share of the travel and a share of
    the turn. The defaults trust it little: wheels may slip by a third of the way."""

    is_measured: bool = True
    """Whether wheels measure the motion; false: it is predicted from the motion before."""
    position_m: float = 0.02
    """Standard deviation of the position, constant part, metres."""
    position_per_travel: float = 0.3
    """Standard deviation of the position per metre of travel, metres per metre."""
    position_per_turn_m: float = 0.05
    """Standard deviation of the position per radian of turn, metres per radian."""
    heading_rad: float = 0.02
    """Standard deviation of the heading, constant part, radians."""
    heading_per_turn: float = 0.2
    """Standard deviation of the heading per radian of turn, radians per radian."""
    heading_per_travel_rad: float = 0.05
    """Standard deviation of the heading per metre of travel, radians per metre."""


WHEELS = OdometryModel()
"""Model of a robot with wheel odometry."""


class OdometryError(NamedTuple):
    """Scale of the error of a motion that wheel odometry measured; the same in every coordinate frame of the plane."""

    position_m: float
    """Standard deviation of x and of y, metres."""
    heading_rad: float
    """Standard deviation of the heading, radians."""

    @property
    def information(self) -> FloatArray:
        """Diagonal information matrix over (x, y, theta), shape (3, 3)."""
        information = np.zeros((3, 3))
        information[0, 0] = information[1, 1] = self.position_m**-2
        information[2, 2] = self.heading_rad**-2
        return information

    def mahalanobis2(self, innovation: Pose) -> float:
        """Squared Mahalanobis length of an innovation (x, y, theta), metres and radians."""
        x, y, theta = innovation
        return float((x * x + y * y) / self.position_m**2 + (theta / self.heading_rad) ** 2)

    def log_likelihood(self, innovation: Pose) -> float:
        """Log-likelihood of an innovation (x, y, theta) relative to none: a Student t distribution with ``TAIL``."""
        return -0.5 * (TAIL + 3.0) * math.log1p(self.mahalanobis2(innovation) / TAIL)


def odometry_error(moved_m: float, turned_rad: float, model: OdometryModel) -> OdometryError:
    """Error of a motion of ``moved_m`` and ``turned_rad`` (not negative) by the model."""
    return OdometryError(
        model.position_m + model.position_per_travel * moved_m + model.position_per_turn_m * turned_rad,
        model.heading_rad + model.heading_per_turn * turned_rad + model.heading_per_travel_rad * moved_m,
    )


@dataclass(frozen=True, slots=True)
class OdometryTrust:
    """The error of one robot's odometry relative to the model, as learned from its good matches."""

    position: float = FIRST_TRUST
    heading: float = FIRST_TRUST
    matches: int = 0
    """Number of matches that it was learned from."""

    def scale(self, error: OdometryError) -> OdometryError:
        """The error of this robot for a motion with ``error`` by the model."""
        return OdometryError(self.position * error.position_m, self.heading * error.heading_rad)

    def learn(self, innovation: Pose, error: OdometryError) -> "OdometryTrust":
        """Learn from the pose of a good match relative to that by odometry, whose error by the model is ``error``."""
        rate = 1.0 / min(FIRST_MATCHES + self.matches, LATEST_MATCHES)
        x, y, theta = innovation
        return OdometryTrust(
            _learned_scale(self.position, 0.5 * (x * x + y * y) / error.position_m**2, rate),
            _learned_scale(self.heading, theta * theta / error.heading_rad**2, rate),
            self.matches + 1,
        )


def _learned_scale(scale: float, squared: float, rate: float) -> float:
    """One step of the recursive estimate of a Student t distribution's scale: an outlier has little weight."""
    weight = (TAIL + 1.0) / (TAIL + squared / scale**2)
    return max(LEAST_TRUST, math.sqrt(scale**2 + rate * (weight * squared - scale**2)))
