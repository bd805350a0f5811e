"""Error of the wheel odometry: a model for every robot, and how far this robot's odometry can be trusted.

A good match measures how far odometry was wrong. These innovations, relative to the model, give the robot its own scale
of the error. Slips are outliers: the error follows a Student t distribution, whose scale is learned robustly.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from pydantic import Field

from fcslam.config import Settings
from fcslam.records import FloatArray

TAIL: float = 1.0
"""Degrees of freedom of the Student t distribution of the error; few, as wheels may slip."""
FIRST_MATCHES, LATEST_MATCHES = 20, 200
"""The model counts as many matches as the first number; later matches replace the oldest of the second number."""
FIRST_TRUST = 0.5
"""Learned scale before the first match: most robots' odometry is better than the model."""
LEAST_TRUST = 0.1
"""Least learned scale: matches have an error of their own."""


class OdometryConfig(Settings):
    """Error of the wheel odometry since the last match, as the sum of a constant, a share of the travel and a share of
    the turn. The defaults trust it little: wheels may slip by a third of the way."""

    is_measured: bool = Field(
        default=True, description="whether wheels measure the motion; false: it is predicted from the motion before"
    )
    position_m: float = Field(default=0.02, gt=0, description="standard deviation of the position, constant part [m]")
    position_per_travel: float = Field(
        default=0.3, ge=0, description="standard deviation of the position per metre of travel [m/m]"
    )
    position_per_turn_m: float = Field(
        default=0.05, ge=0, description="standard deviation of the position per radian of turn [m/rad]"
    )
    heading_rad: float = Field(default=0.02, gt=0, description="standard deviation of the heading, constant part [rad]")
    heading_per_turn: float = Field(
        default=0.2, ge=0, description="standard deviation of the heading per radian of turn [rad/rad]"
    )
    heading_per_travel_rad: float = Field(
        default=0.05, ge=0, description="standard deviation of the heading per metre of travel [rad/m]"
    )


class OdometryError(NamedTuple):
    """Scale of the error of a motion that wheel odometry measured; the same in every coordinate frame of the plane."""

    position_m: float
    """Standard deviation of x and of y, metres."""
    heading_rad: float
    """Standard deviation of the heading, radians."""

    @property
    def information(self) -> FloatArray:
        """Diagonal information matrix over (x, y, theta), shape (3, 3)."""
        return np.diag((self.position_m**-2, self.position_m**-2, self.heading_rad**-2))

    def mahalanobis2(self, innovation: FloatArray) -> float:
        """Squared Mahalanobis length of an innovation (x, y, theta), shape (3,), metres and radians."""
        x, y, theta = innovation.tolist()
        return float((x * x + y * y) / self.position_m**2 + (theta / self.heading_rad) ** 2)

    def log_likelihood(self, innovation: FloatArray) -> float:
        """Log-likelihood of an innovation, shape (3,), relative to none: a Student t distribution with ``TAIL``."""
        return -0.5 * (TAIL + 3.0) * math.log1p(self.mahalanobis2(innovation) / TAIL)


def odometry_error(moved_m: float, turned_rad: float, config: OdometryConfig) -> OdometryError:
    """Error of a motion by the model for every robot.

    Args:
        moved_m: travel, metres.
        turned_rad: turn, radians, not negative.
        config: the model.
    """
    return OdometryError(
        config.position_m + config.position_per_travel * moved_m + config.position_per_turn_m * turned_rad,
        config.heading_rad + config.heading_per_turn * turned_rad + config.heading_per_travel_rad * moved_m,
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

    def learn(self, innovation: FloatArray, error: OdometryError) -> "OdometryTrust":
        """Learn from a good match.

        Args:
            innovation: matched pose relative to the pose by odometry, shape (3,), metres and radians.
            error: error of that motion by the model.
        """
        rate = 1.0 / min(FIRST_MATCHES + self.matches, LATEST_MATCHES)
        x, y, theta = innovation.tolist()
        return OdometryTrust(
            _learned_scale(self.position, 0.5 * (x * x + y * y) / error.position_m**2, rate),
            _learned_scale(self.heading, theta * theta / error.heading_rad**2, rate),
            self.matches + 1,
        )


def _learned_scale(scale: float, squared: float, rate: float) -> float:
    """One step of the recursive estimate of a Student t distribution's scale: an outlier has little weight."""
    weight = (TAIL + 1.0) / (TAIL + squared / scale**2)
    return max(LEAST_TRUST, math.sqrt(scale**2 + rate * (weight * squared - scale**2)))
