"""Geometric verification: whether two submaps show the same place, and the transform between them."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from fcslam.geometry import se2
from fcslam.lidar.matching import limited_information, match_scan
from fcslam.lidar.scan import PointScan
from fcslam.lidar.submap import Agreement, Submap, agreement
from fcslam.records import FloatArray, Reason, ReasonCode

UNFIXED = 1e-2
"""Information in a direction that no point fixes: a standard deviation of 10 m or 10 rad."""
ALIGNED_POINTS = 400
"""Least number of aligned points of a submap; smaller submaps align all their points."""
NOISE_FACTOR = 2.0
"""Noise raises the limit of a gate's violation by no more than this factor: people who walk about are not noise."""
NO_PRIOR = np.zeros((3, 3))
_VERIFIED = Reason(ReasonCode.VERIFIED)
ALIGNMENT_SCALE_M = 0.4
"""A guess between submaps is worse than one between scans: the loss starts wider."""
INFORMATIVE, INFORMATIVE_SHARE = 30.0, 0.1
"""Least eigenvalue of the normal tensor of an informative closure, and its least share of the number of points: along a
bare corridor, the noise of the normals alone gives 0.02 to 0.1."""
CLOSURE_SIGMA_M = 0.03
CLOSURE_SIGMA_RAD = 0.2 * CLOSURE_SIGMA_M
"""Least standard deviations of a closure, however many points it has."""
SYMMETRY_M, SYMMETRY_RAD = 5.0 * CLOSURE_SIGMA_M, 5.0 * CLOSURE_SIGMA_RAD
"""Largest motion between the alignments of both directions."""
LEAST_VARIANCE = CLOSURE_SIGMA_M**2, CLOSURE_SIGMA_M**2, CLOSURE_SIGMA_RAD**2


@dataclass(frozen=True, slots=True)
class Gate:
    """Thresholds for two submaps to show the same place."""

    explained: float
    """Least share of the points in known area that lie on a surface, in either direction."""
    violation: float
    """Largest share of the points in known area that lie in the other submap's free space."""
    count: int
    """Least number of points on a surface; points are 0.1 m apart."""
    overlap: float
    """Least share of all points that lie in known area."""


STRICT = Gate(explained=0.80, violation=0.05, count=150, overlap=0.25)
"""Gate of a closure that no estimate predicts."""
LOOSE = Gate(explained=0.70, violation=0.10, count=250, overlap=0.25)
"""Gate of a closure that an estimate predicts."""
PARTIAL = Gate(explained=0.65, violation=0.22, count=500, overlap=0.5)
"""Gate of a partially supported closure: much overlap, but bent submaps (outdoors, on a slope). It counts half in a
cluster, and never alone."""


@dataclass(frozen=True, slots=True)
class Verification:
    """Result of aligning submap b with submap a."""

    T_a_b: FloatArray
    information: FloatArray
    """Information of T_a_b in the tangent space at T_a_b (coordinates of b), shape (3, 3)."""
    worse: Agreement
    """The worse of both directions in each measure, and the better overlap: a small submap may lie in a large one."""
    strict: bool
    loose: bool
    partial: bool
    """Passes the gate of this name; ``partial`` closures are informative, too."""
    informative: bool
    """Whether it fixes the pose in every direction."""
    reason: Reason
    """Why it is not strict and informative, or that it is verified."""
    loose_reason: Reason
    """The same for the loose gate."""

    @property
    def support(self) -> float:
        """Weight in a cluster of consistent closures: 1 if strict, 0.5 if only partial, else 0."""
        return 1.0 if self.strict else 0.5 * self.partial


class Aligned(NamedTuple):
    """Two submaps aligned in both directions; the fields are those of ``Verification``."""

    T_a_b: FloatArray
    information: FloatArray
    worse: Agreement
    gap: FloatArray
    """Motion between both alignments, shape (3,), metres and radians."""


def no_noise() -> float:
    """Submaps that do not contradict themselves."""
    return 0.0


def verify(a: Submap, b: Submap, T_a_b_guess: FloatArray, prior: FloatArray = NO_PRIOR) -> Verification:
    """Check whether two submaps show the same place: align them in both directions and rate the worse one.

    Args:
        a, b: submaps, each in the coordinate frame of its anchor.
        T_a_b_guess: where the Gauss-Newton alignment starts, shape (3,), metres and radians.
        prior: information of the guess from matched keypoints, over (x, y, theta) in the coordinates of a, shape
            (3, 3). It fixes the alignment where no wall does, as along a corridor. It does not make a closure
            informative: structure that repeats along a corridor repeats in images, too.
    """
    return judge(align(a, b, T_a_b_guess, prior))


def align(a: Submap, b: Submap, T_a_b_guess: FloatArray, prior: FloatArray = NO_PRIOR) -> Aligned:
    """The slow part of ``verify``: the alignment, which does not depend on the noise of the submaps."""
    forward = match_scan(_sample(b.surface), a.field, T_a_b_guess, prior, wide_scale_m=ALIGNMENT_SCALE_M)
    # The prior must not count twice: backward it acts at the guess, as it does forward.
    start = T_a_b_guess if prior.any() else forward.T_field_base
    backward = match_scan(
        _sample(a.surface),
        b.field,
        se2.inverse(start),
        _information_of_inverse(prior, start),
        wide_scale_m=ALIGNMENT_SCALE_M,
    )
    T_a_b, T_a_b_back = forward.T_field_base, se2.inverse(backward.T_field_base)
    gap = se2.between(T_a_b, T_a_b_back)
    T_a_b = se2.compose(T_a_b, 0.5 * gap)
    sides = agreement(b, a, T_a_b), agreement(a, b, se2.inverse(T_a_b))
    worse = Agreement(
        min(side.explained for side in sides),
        max(side.violation for side in sides),
        min(side.count for side in sides),
        max(side.overlap for side in sides),
        min(sides, key=lambda side: side.weakest).normal_tensor,
    )
    information = limited_information(
        forward.information + prior, float(T_a_b[2]), (UNFIXED, UNFIXED, UNFIXED), LEAST_VARIANCE
    )
    return Aligned(T_a_b, information, worse, gap)


def judge(
    aligned: Aligned, noise: Callable[[], float] = no_noise, predicted: bool = False, loose: Gate = LOOSE
) -> Verification:
    """Which gates an alignment passes.

    ``noise`` is the sum of both submaps' violation of themselves (``self_violation``), called only where it decides: it
    takes as long as to build two submaps. Two submaps cannot agree better than each agrees with itself, so a noisy
    scanner is allowed as much violation. Where an estimate has ``predicted`` the closure, the loose gate decides, and
    else the strict one; the noise counts for the gate that decides.
    """
    worse, weakest = aligned.worse, aligned.worse.weakest
    asymmetric = _asymmetry(aligned.gap)
    symmetric = asymmetric is None
    if asymmetric is not None:
        noise = no_noise  # it takes two submaps, and decides nothing
    least = max(INFORMATIVE, INFORMATIVE_SHARE * worse.count)
    informative = weakest >= least
    one_direction = Reason(ReasonCode.ONE_DIRECTION, weakest, least)
    not_strict = _shortfall(worse, STRICT, no_noise if predicted else noise)
    not_loose = _shortfall(worse, loose, noise if predicted else no_noise)
    return Verification(
        T_a_b=aligned.T_a_b,
        information=aligned.information,
        worse=worse,
        strict=symmetric and not not_strict,
        loose=symmetric and not not_loose,
        partial=symmetric and informative and not _shortfall(worse, PARTIAL, no_noise),
        informative=informative,
        reason=asymmetric or not_strict or (_VERIFIED if informative else one_direction),
        loose_reason=asymmetric or not_loose or _VERIFIED,
    )


def _sample(surface: PointScan) -> PointScan:
    """About ``ALIGNED_POINTS`` points: more add little. Copied, so that compiled code sees one memory layout."""
    return surface.only(np.arange(0, len(surface), max(1, len(surface) // ALIGNED_POINTS)))


def _asymmetry(gap: FloatArray) -> Reason | None:
    if (gap_m := float(np.hypot(gap[0], gap[1]))) >= SYMMETRY_M:
        return Reason(ReasonCode.ASYMMETRIC, gap_m, SYMMETRY_M)
    if (gap_rad := abs(float(gap[2]))) >= SYMMETRY_RAD:
        return Reason(ReasonCode.ASYMMETRIC, gap_rad, SYMMETRY_RAD)
    return None


def _shortfall(found: Agreement, gate: Gate, noise: Callable[[], float]) -> Reason | None:
    if found.explained < gate.explained:
        return Reason(ReasonCode.NOT_ENOUGH_EXPLAINED, found.explained, gate.explained)
    if found.count < gate.count:
        return Reason(ReasonCode.FEW_POINTS, found.count, gate.count)
    if found.overlap < gate.overlap:
        return Reason(ReasonCode.LITTLE_OVERLAP, found.overlap, gate.overlap)
    if found.violation > gate.violation and found.violation > (limit := _noisy_limit(found, gate, noise)):
        return Reason(ReasonCode.IN_FREE_SPACE, found.violation, limit)
    return None


def _noisy_limit(found: Agreement, gate: Gate, noise: Callable[[], float]) -> float:
    if found.violation > NOISE_FACTOR * gate.violation:
        return gate.violation
    return min(NOISE_FACTOR * gate.violation, max(gate.violation, noise()))


def _information_of_inverse(information: FloatArray, T_a_b: FloatArray) -> FloatArray:
    """Information of T_a_b over (x, y, theta) in a, shape (3, 3), as information of T_b_a over (x, y, theta) in b."""
    x, y, theta = T_a_b
    cos, sin = np.cos(theta), np.sin(theta)
    # The derivative of T_b_a = (-R' t, -theta) by T_a_b.
    jacobian = np.array([[-cos, -sin, sin * x - cos * y], [sin, -cos, cos * x + sin * y], [0.0, 0.0, -1.0]])
    inverse = np.linalg.inv(jacobian)
    return np.asarray(inverse.T @ information @ inverse)
