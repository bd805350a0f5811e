"""Do two submaps show the same place, and how do they lie to each other? Geometry decides, and it may say no."""

from dataclasses import dataclass

import numpy as np
from pydantic import Field

from fcslam.config import Settings
from fcslam.geometry import se2
from fcslam.lidar.matching import MatchingConfig, match_scan
from fcslam.lidar.scan import PointScan
from fcslam.lidar.submap import Agreement, Submap, agreement
from fcslam.records import FloatArray

WEAKEST = 1e-2
"""Information left in a direction that no point fixes: 10 m or 10 rad."""
ALIGNED_POINTS = 400
"""At least so many points of a submap align it, if it has them."""
NO_PRIOR = np.zeros((3, 3))
_ALIGNMENT = MatchingConfig(wide_scale_m=0.4)


class Gate(Settings):
    """What a pair of submaps has to show to count as the same place where nothing predicts it."""

    explained: float = Field(
        default=0.80, ge=0, le=1, description="least share of points in known area that lie on a surface"
    )
    violation: float = Field(default=0.05, ge=0, le=1, description="largest share of points in the other's free space")
    count: int = Field(default=250, ge=0, description="least number of explained points, 0.1 m apart")
    overlap: float = Field(default=0.25, ge=0, le=1, description="least share of points in known area")


class LooseGate(Gate):
    """The same where the estimate predicts the closure."""

    explained: float = Field(default=0.70, ge=0, le=1, description="as in strict")
    violation: float = Field(default=0.10, ge=0, le=1, description="as in strict")


class PartialGate(Gate):
    """The same for half a witness: much is seen, but the submaps are bent (outdoors, on a slope)."""

    explained: float = Field(default=0.65, ge=0, le=1, description="as in strict")
    violation: float = Field(default=0.22, ge=0, le=1, description="as in strict")
    count: int = Field(default=500, ge=0, description="as in strict")
    overlap: float = Field(default=0.5, ge=0, le=1, description="as in strict")


class VerificationConfig(Settings):
    """Two-way verification of closures between submaps."""

    strict: Gate = Field(default=Gate(), description="gate without a prediction")
    loose: LooseGate = Field(default=LooseGate(), description="gate where a closure is predicted")
    partial: PartialGate = Field(default=PartialGate(), description="gate for half a witness: much is seen, but bent")
    informative: float = Field(
        default=30.0, ge=0, description="least small eigenvalue of the normal tensor: below, it may be a corridor"
    )
    symmetry_m: float = Field(default=0.15, gt=0, description="both directions of the alignment agree this closely")
    symmetry_rad: float = Field(default=0.03, gt=0, description="and turn alike to this")
    closure_sigma_m: float = Field(default=0.03, gt=0, description="error of a closure that no point count removes")
    closure_sigma_rad: float = Field(default=0.006, gt=0, description="the same of its heading")


@dataclass(frozen=True, slots=True)
class Verification:
    """The outcome of laying submap b on submap a."""

    T_a_b: FloatArray
    information: FloatArray
    """Of T_a_b, in the coordinates of b, shape (3, 3)."""
    worse: Agreement
    """What the two directions have in common: of each measure the worse, but of the overlap the better one, since a
    small submap may lie within a large one."""
    strict: bool
    loose: bool
    partial: bool
    informative: bool
    reason: str
    """Why it is not more, in words; empty if strict and informative."""

    @property
    def support(self) -> float:
        """What it counts for in a cluster of closures that agree: 1 if strict, a half if only partial, else nothing."""
        return 1.0 if self.strict else 0.5 * self.partial


def verify(
    a: Submap, b: Submap, T_a_b_guess: FloatArray, config: VerificationConfig, prior: FloatArray = NO_PRIOR
) -> Verification:
    """Align both ways by Gauss-Newton from the guess, then judge by the worse side.

    Args:
        a: one submap.
        b: the other.
        T_a_b_guess: where the alignment starts, shape (3,).
        config: what the pair has to show.
        prior: information of the guess from elsewhere, of (x, y, theta) in a's coordinates, shape (3, 3): along a
            corridor, where no wall holds the alignment, matched keypoints do. It makes nothing informative: what
            repeats along a corridor repeats in images, too, and only walls may say that a match is fixed.
    """
    forward = match_scan(_sample(b.surface), a.field, T_a_b_guess, prior, _ALIGNMENT)
    # A prior must not be believed twice: backward it holds the alignment where it did forward, at the guess.
    start = T_a_b_guess if prior.any() else forward.T_field_base
    backward = match_scan(_sample(a.surface), b.field, se2.inverse(start), _of_inverse(prior, start), _ALIGNMENT)
    T_a_b, T_a_b_back = forward.T_field_base, se2.inverse(backward.T_field_base)
    gap = se2.between(T_a_b, T_a_b_back)
    T_a_b = se2.compose(T_a_b, 0.5 * gap)
    sides = agreement(b, a, T_a_b), agreement(a, b, se2.inverse(T_a_b))
    worse = min(sides, key=lambda side: side.explained - side.violation)
    worse = Agreement(
        worse.explained,
        max(side.violation for side in sides),
        min(side.count for side in sides),
        max(side.overlap for side in sides),
        worse.normal_tensor,
    )
    symmetric = np.hypot(gap[0], gap[1]) < config.symmetry_m and abs(gap[2]) < config.symmetry_rad
    informative = worse.weakest >= config.informative
    strict_reason = _shortfall(worse, config.strict)
    reason = strict_reason or ("" if informative else "fixed in one direction only, as in a corridor")
    return Verification(
        T_a_b=T_a_b,
        information=_information(forward.information + prior, T_a_b, config),
        worse=worse,
        strict=symmetric and not strict_reason,
        loose=symmetric and not _shortfall(worse, config.loose),
        partial=symmetric and informative and not _shortfall(worse, config.partial),
        informative=informative,
        reason=reason if symmetric else "the two directions of the alignment disagree",
    )


def _sample(surface: PointScan) -> PointScan:
    """Enough points to align by: more would say the same again. Copied: compiled code sees one layout of arrays."""
    return surface.only(np.arange(0, len(surface), max(1, len(surface) // ALIGNED_POINTS)))


def _shortfall(found: Agreement, gate: Gate) -> str:
    """The first condition of the gate that is not met, in words."""
    if found.explained < gate.explained:
        return f"only {found.explained:.2f} explained"
    if found.violation > gate.violation:
        return f"{found.violation:.2f} in free space"
    if found.count < gate.count:
        return f"only {found.count} points explained"
    if found.overlap < gate.overlap:
        return f"overlap of {found.overlap:.2f}"
    return ""


def _of_inverse(information: FloatArray, T_a_b: FloatArray) -> FloatArray:
    """Information of T_a_b, of (x, y, theta) in a, as that of T_b_a, of (x, y, theta) in b."""
    x, y, theta = T_a_b
    cos, sin = np.cos(theta), np.sin(theta)
    # T_b_a = (-R' t, -theta); this is its derivative, which is its own inverse's shape
    jacobian = np.array([[-cos, -sin, sin * x - cos * y], [sin, -cos, cos * x + sin * y], [0.0, 0.0, -1.0]])
    inverse = np.linalg.inv(jacobian)
    return np.asarray(inverse.T @ information @ inverse)


def _information(points: FloatArray, T_a_b: FloatArray, config: VerificationConfig) -> FloatArray:
    """Points' information turned into b's coordinates, with the floor that neighbouring points share."""
    turn = np.eye(3)
    cos, sin = np.cos(T_a_b[2]), np.sin(T_a_b[2])
    turn[:2, :2] = ((cos, -sin), (sin, cos))
    covariance = np.linalg.inv(turn.T @ points @ turn + np.diag((WEAKEST, WEAKEST, WEAKEST)))
    floor = np.diag((config.closure_sigma_m**2, config.closure_sigma_m**2, config.closure_sigma_rad**2))
    information = np.linalg.inv(covariance + floor)
    return np.asarray(0.5 * (information + information.T))
