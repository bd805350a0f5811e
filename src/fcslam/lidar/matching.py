"""Scan matching: Gauss-Newton on the distances of a scan's points to the nearest surfels."""

from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from fcslam.compiled import njit
from fcslam.config import Settings
from fcslam.lidar.field import EMPTY, SurfelField, label_at
from fcslam.lidar.scan import PointScan
from fcslam.records import FloatArray

OPPOSED: Final = -0.1
"""Normals with a smaller dot product face away from each other; those at a right angle, as at a corner, do not."""
ALONG: Final = 0.25
"""Weight of the squared distance along the surface, relative to that across it, in a point's robust weight."""

NO_NORMAL_WEIGHT: Final = 0.5
"""Weight of points without a normal: their surface is uncertain."""
ALONG_LIMIT2: Final = 9.0
"""A point on a surface is within 3 times ``explained_m`` of the surfel itself (squared): the surface ends somewhere."""
DAMPING: Final = 1e-6
"""Added to the diagonal of the normal equations, so that an unconstrained direction stays solvable."""
SMALL_STEP_M: Final = 2e-4
SMALL_STEP_RAD: Final = 1e-4
"""A smaller step means that Gauss-Newton has converged at the present scale of the loss."""
INLIER_SIGMA_M: Final = 0.06
"""Standard deviation of a point's distance to its surface, for the likelihood of a scan."""
INLIER_RATIO: Final = 20.0
"""Density of points on their surface relative to that of outliers."""
INDEPENDENT: Final = 0.2
"""Share of the points' log-likelihood that counts: errors of neighbouring points are correlated, five count as one."""
SHRINK: Final = 0.6
FAST_SHRINK: Final = 0.35
"""Factor of the loss scale after each step; the fast one after a small step."""


class MatchingConfig(Settings):
    """Gauss-Newton scan matching."""

    iterations: int = Field(default=20, gt=0, description="largest number of Gauss-Newton steps")
    wide_scale_m: float = Field(default=0.30, gt=0, description="scale of the robust loss at the first step [m]")
    narrow_scale_m: float = Field(default=0.06, gt=0, description="scale of the robust loss at the last step [m]")
    point_sigma_m: float = Field(
        default=0.03,
        gt=0,
        description="standard deviation of a point's distance; wide, as errors of neighbours are correlated [m]",
    )
    explained_m: float = Field(default=0.10, gt=0, description="a point this close to its surface lies on it [m]")


@dataclass(frozen=True, slots=True)
class ScanMatch:
    """Pose of a scan in a field."""

    T_field_base: FloatArray
    """Shape (3,), metres and radians."""
    information: FloatArray
    """Information of the points without the prior, over (x, y) in the field and theta, shape (3, 3)."""
    explained: float
    """Share of the scan's points that lie on a surface."""
    known: float
    """Share of the scan's points that fall near any surface."""
    log_likelihood: float
    """Log-likelihood of the scan, relative to a scan without a point on a surface.

    Each point lies on its nearest surface, with a normally distributed distance, or is an outlier.
    """


def match_scan(
    scan: PointScan,
    field: SurfelField,
    T_field_guess: FloatArray,
    prior_information: FloatArray,
    config: MatchingConfig,
) -> ScanMatch:
    """Find the pose that minimises the robust distances of the points to the field, with a prior at the guess.

    Args:
        scan: points in ``base``.
        field: surfaces.
        T_field_guess: start, and mean of the prior, shape (3,), metres and radians.
        prior_information: over (x, y, theta) in the field's coordinates, shape (3, 3); zeros for no prior.
        config: loss and iterations.

    Returns:
        The pose, the information of the points, and how well they fit.
    """
    pose, information, explained, known, log_likelihood = _match(
        _Points(scan.points, scan.normals, scan.solitary, scan.origin),
        np.array(T_field_guess), prior_information, field.arrays,  # a writable copy: code is compiled once
        config.iterations, config.wide_scale_m, config.narrow_scale_m, config.point_sigma_m, config.explained_m,
    )  # fmt: skip
    return ScanMatch(pose, information, explained, known, INDEPENDENT * log_likelihood)


class _Points(NamedTuple):
    """The arrays of a scan, for compiled code."""

    points: FloatArray
    normals: FloatArray
    solitary: NDArray[np.bool_]
    origin: FloatArray


@njit
def _match(scan, guess, prior, field, iterations, wide, narrow, sigma, explained_m):  # type: ignore[no-untyped-def]
    """Gauss-Newton while the scale of the loss shrinks from ``wide`` to ``narrow``."""
    pose = guess.copy()
    scale = wide
    for _ in range(iterations):
        H, g = _normal_equations(scan, pose, field, scale)
        x, y = pose[0] - guess[0], pose[1] - guess[1]
        theta = (pose[2] - guess[2] + np.pi) % (2.0 * np.pi) - np.pi
        for r in range(3):
            g[r] = g[r] / (sigma * sigma) + prior[r, 0] * x + prior[r, 1] * y + prior[r, 2] * theta
            for c in range(3):
                H[r, c] = H[r, c] / (sigma * sigma) + prior[r, c]
            H[r, r] += DAMPING
        step = _solve(H, g)
        for r in range(3):
            pose[r] -= step[r]
        small = abs(step[0]) + abs(step[1]) < SMALL_STEP_M and abs(step[2]) < SMALL_STEP_RAD
        if small and scale <= narrow:
            break
        scale = max(narrow, scale * (FAST_SHRINK if small else SHRINK))
    pose[2] = (pose[2] + np.pi) % (2.0 * np.pi) - np.pi
    H, g = _normal_equations(scan, pose, field, narrow)
    return (pose, H / (sigma * sigma), *_fit(scan, pose, field, explained_m))


@njit(allocates=False)
def _solve(A, b):  # type: ignore[no-untyped-def]
    """Solution of A x = b for a positive definite A (3, 3), by its LDL decomposition; compiles faster than LAPACK."""
    l10, l20 = A[1, 0] / A[0, 0], A[2, 0] / A[0, 0]
    d1 = A[1, 1] - l10 * A[1, 0]
    l21 = (A[2, 1] - l20 * A[1, 0]) / d1
    d2 = A[2, 2] - l20 * A[2, 0] - l21 * l21 * d1
    y1 = b[1] - l10 * b[0]
    z = (b[2] - l20 * b[0] - l21 * y1) / d2
    y = y1 / d1 - l21 * z
    return b[0] / A[0, 0] - l10 * y - l20 * z, y, z


@njit
def _normal_equations(scan, pose, field, scale):  # type: ignore[no-untyped-def]
    hxx, hxy, hxt, hyy, hyt, htt, gx, gy, gt = _sums(scan, pose, field, scale)
    return np.array(((hxx, hxy, hxt), (hxy, hyy, hyt), (hxt, hyt, htt))), np.array((gx, gy, gt))


@njit(allocates=False)
def _sums(scan, pose, field, scale):  # type: ignore[no-untyped-def]
    """Point-to-line where a normal is known, point-to-point for solitary returns; Geman-McClure weights."""
    hxx = hxy = hxt = hyy = hyt = htt = gx = gy = gt = 0.0  # scalars, which stay in registers
    points, normals, surfels = scan.points, scan.normals, field.surfels
    cos, sin = np.cos(pose[2]), np.sin(pose[2])
    c2 = scale * scale
    for i in range(len(points)):
        rx = cos * points[i, 0] - sin * points[i, 1]
        ry = sin * points[i, 0] + cos * points[i, 1]
        x, y = pose[0] + rx, pose[1] + ry
        label = label_at(x, y, field)
        if label == EMPTY:
            continue
        s = surfels[label]
        dx, dy = x - s[0], y - s[1]
        nx, ny = s[2], s[3]
        mx = cos * normals[i, 0] - sin * normals[i, 1]
        my = sin * normals[i, 0] + cos * normals[i, 1]
        if nx * mx + ny * my < OPPOSED:  # the two sides of a thin wall do not attract each other
            continue
        d2 = dx * dx + dy * dy
        if nx == 0.0 and ny == 0.0:
            nx, ny = mx, my
        if nx == 0.0 and ny == 0.0:
            w = NO_NORMAL_WEIGHT * (c2 / (c2 + d2)) ** 2
            if scan.solitary[i]:  # two lines through the surfel: along x here, along y below
                hyy += w
                hyt += w * rx
                htt += w * rx * rx
                gy += w * dy
                gt += w * rx * dy
                nx = 1.0
            else:
                # Far along a wall, returns in a row repeat the pattern of the beams: their range would bind the robot
                # to its previous position with false certainty. Only their bearing counts.
                bx, by = points[i, 0] - scan.origin[0], points[i, 1] - scan.origin[1]
                length = max(np.hypot(bx, by), 1e-9)
                nx, ny = -(sin * bx + cos * by) / length, (cos * bx - sin * by) / length
            e = nx * dx + ny * dy
        else:
            e = nx * dx + ny * dy
            along2 = max(0.0, d2 - e * e)
            w = (c2 / (c2 + e * e + ALONG * along2)) ** 2
        t = ny * rx - nx * ry
        hxx += w * nx * nx
        hxy += w * nx * ny
        hxt += w * nx * t
        hyy += w * ny * ny
        hyt += w * ny * t
        htt += w * t * t
        gx += w * nx * e
        gy += w * ny * e
        gt += w * t * e
    return hxx, hxy, hxt, hyy, hyt, htt, gx, gy, gt


@njit(allocates=False)
def _fit(scan, pose, field, limit):  # type: ignore[no-untyped-def]
    """Share of the points on a surface, share near any, and the log-likelihood of the points."""
    points, normals, surfels = scan.points, scan.normals, field.surfels
    cos, sin = np.cos(pose[2]), np.sin(pose[2])
    explained = known = 0
    total = 0.0
    for i in range(len(points)):
        x = pose[0] + cos * points[i, 0] - sin * points[i, 1]
        y = pose[1] + sin * points[i, 0] + cos * points[i, 1]
        label = label_at(x, y, field)
        if label == EMPTY:
            continue
        known += 1
        s = surfels[label]
        mx = cos * normals[i, 0] - sin * normals[i, 1]
        my = sin * normals[i, 0] + cos * normals[i, 1]
        if s[2] * mx + s[3] * my < OPPOSED:
            continue
        dx, dy = x - s[0], y - s[1]
        d2 = dx * dx + dy * dy
        if s[2] == 0.0 and s[3] == 0.0:
            likely2 = d2
            on_surface = d2 < limit * limit
        else:
            e = s[2] * dx + s[3] * dy
            likely2 = e * e + ALONG * (d2 - e * e)
            on_surface = abs(e) < limit and d2 <= ALONG_LIMIT2 * limit * limit
        if on_surface:
            explained += 1
        total += np.log1p(INLIER_RATIO * np.exp(-0.5 * likely2 / (INLIER_SIGMA_M * INLIER_SIGMA_M)))
    n = max(1, len(points))
    return explained / n, known / n, total
