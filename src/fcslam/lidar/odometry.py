"""Error of the wheel odometry: a model for every robot, and how far this robot's odometry can be trusted.

A good match measures how far odometry was wrong. These innovations, relative to the model, give the robot its own scale
of the error. Slips are outliers: the error follows a Student t distribution, whose scale is learned robustly. The part
that is a share of the motion, as of wheels with another radius, is estimated and corrected.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from fcslam.geometry.se2 import Pose
from fcslam.records import FloatArray

TAIL: float = 1.0
"""Degrees of freedom of the Student t distribution of the error; few, as wheels may slip."""
PRIOR_TAIL: float = 3.0
"""The same in the prior of a match once the error is learned. Gauss-Newton would stay at odometry with fewer."""
FIRST_MATCHES = 20
LATEST_MATCHES = 10 * FIRST_MATCHES
"""The model counts as many matches as the first number; later matches replace the oldest of the second number."""
FIRST_TRUST = 0.5
"""Learned scale before the first match: most robots' odometry is better than the model."""
LEAST_TRUST = 0.1
"""Least learned scale: matches have an error of their own."""
FIRST_WEIGHT, LARGEST_WEIGHT = 0.05, 3.0
"""Sum of squared motions (m^2 or rad^2) that a ratio of 1 counts as before the first match, and the largest sum, beyond
which the oldest matches are forgotten: tyres wear."""


@dataclass(frozen=True, slots=True)
class OdometryModel:
    """Error of the wheel odometry since the last match, as the sum of a constant, a share of the travel and a share of
    the turn: standard deviations in metres and radians, per metre of travel and radian of turn. The defaults trust it
    little: wheels may slip by a third of the way."""

    is_measured: bool = True
    """Whether wheels measure the motion; false: it is predicted from the motion before."""
    position_m: float = 0.02
    position_per_travel: float = 0.3
    position_per_turn_m: float = 0.05
    heading_rad: float = 0.02
    heading_per_turn: float = 0.2
    heading_per_travel_rad: float = 0.05


WHEELS = OdometryModel()
"""Model of a robot with wheel odometry."""
PREDICTED = OdometryModel(
    is_measured=False, position_m=0.1, position_per_travel=0.5, heading_rad=0.1, heading_per_turn=0.5
)
"""Model without odometry: every scan is matched; a robot may brake or turn by so much within a tenth of a second."""


class OdometryError(NamedTuple):
    """Scale of the error of a motion that wheel odometry measured; the same in every coordinate frame of the plane."""

    position_m: float
    """Standard deviation of x and of y."""
    heading_rad: float

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


class MotionRatio(NamedTuple):
    """How far a robot moves, or turns, per motion that its odometry measures, by recursive least squares."""

    value: float = 1.0
    weight: float = FIRST_WEIGHT

    def learn(self, squared: float, product: float) -> "MotionRatio":
        """Learn from a motion: its square, and its product with what the corrected motion lacks, both weighted."""
        weight = min(self.weight + squared, LARGEST_WEIGHT)
        return MotionRatio(self.value + product / weight, weight)


_UNLEARNED = MotionRatio()


@dataclass(frozen=True, slots=True)
class OdometryTrust:
    """The error of one robot's odometry relative to the model, as learned from its good matches."""

    position: float = FIRST_TRUST
    heading: float = FIRST_TRUST
    matches: int = 0
    """Number of matches that it was learned from."""
    distance: MotionRatio = _UNLEARNED
    turn: MotionRatio = _UNLEARNED

    def motion(self, measured: Pose) -> Pose:
        """The robot's motion (x, y, theta) where odometry measured another."""
        x, y, theta = measured
        return self.distance.value * x, self.distance.value * y, self.turn.value * theta

    def scale(self, error: OdometryError) -> OdometryError:
        """The error of this robot for a motion with ``error`` by the model."""
        return OdometryError(self.position * error.position_m, self.heading * error.heading_rad)

    def learn(self, innovation: Pose, error: OdometryError, measured: Pose = (0.0, 0.0, 0.0)) -> "OdometryTrust":
        """Learn from a good match.

        Args:
            innovation: pose of the match relative to that by ``motion``, metres and radians.
            error: error of odometry by the model.
            measured: motion by odometry since the last match; zeros if nothing is to be learned about its ratios.
        """
        rate = 1.0 / min(FIRST_MATCHES + self.matches, LATEST_MATCHES)
        own = self.scale(error)
        (x, y, theta), (dx, dy, turn) = innovation, measured
        weight = _outlier_weight((x * x + y * y) / own.position_m**2)
        turn_weight = _outlier_weight((theta / own.heading_rad) ** 2)
        return OdometryTrust(
            _learned_scale(self.position, 0.5 * (x * x + y * y) / error.position_m**2, rate),
            _learned_scale(self.heading, theta * theta / error.heading_rad**2, rate),
            self.matches + 1,
            self.distance.learn(weight * (dx * dx + dy * dy), weight * (dx * x + dy * y)),
            self.turn.learn(turn_weight * turn * turn, turn_weight * turn * theta),
        )


def _outlier_weight(squared: float) -> float:
    """Weight of an error with this squared Mahalanobis length in one direction: slips have little."""
    return (TAIL + 1.0) / (TAIL + squared)


def _learned_scale(scale: float, squared: float, rate: float) -> float:
    """One step of the recursive estimate of a Student t distribution's scale: an outlier has little weight."""
    return max(LEAST_TRUST, math.sqrt(scale**2 + rate * (_outlier_weight(squared / scale**2) * squared - scale**2)))
