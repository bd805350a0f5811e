"""Scan matching: Gauss-Newton on the distances of a scan's points to the nearest surfels."""

import math
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fcslam.compiled import njit
from fcslam.lidar.field import EMPTY, FIRST_SEEN, MERGED, SurfelField, label_at
from fcslam.lidar.scan import PointScan
from fcslam.records import FloatArray

OPPOSED: Final = -0.1
"""Normals with a smaller dot product face away from each other; those at a right angle, as at a corner, do not."""
ALONG: Final = 0.25
"""Weight of the squared distance along the surface, relative to that across it, in a point's robust weight."""

NO_NORMAL_WEIGHT: Final = 0.5
"""Weight of points without a normal: their surface is uncertain."""
NEW_MOTION: Final = 1000
"""A surface is new until the robot has moved by this much since it was first seen, in mm, turns in mrad."""
MOST_NEW: Final = 2.0
"""Largest weight of all points on new surfaces per that of those on older ones, where each keeps the least weight."""
LEAST_NEW_WEIGHT: Final = 0.3
"""Least weight of a point on a new surface, as where hardly anything else is seen and odometry may slip."""
ALONG_LIMIT2: Final = 9.0
"""A point on a surface is within 3 times ``EXPLAINED_M`` of the surfel itself (squared): the surface ends somewhere."""
DAMPING: Final = 1e-6
"""Added to the diagonal of the normal equations, so that an unconstrained direction stays solvable."""
SMALL_STEP_M: Final = 2e-4
SMALL_STEP_RAD: Final = 0.5 * SMALL_STEP_M
"""A smaller step means that Gauss-Newton has converged at the present scale of the loss."""
INLIER_RATIO: Final = 20.0
"""Density of points on their surface relative to that of outliers."""
INDEPENDENT: Final = 0.2
"""Share of the points' log-likelihood that counts: errors of neighbouring points are correlated, five count as one."""
FIXED: Final = np.full(3, 1e18)
"""Information of a velocity that is known, far beyond the square of what the points say against it."""
SHRINK: Final = 0.6
FAST_SHRINK: Final = 0.35
"""Factor of the loss scale after each step; the fast one after a small step."""
MOST_ITERATIONS = 20
"""Largest number of Gauss-Newton steps."""
NARROW_SCALE_M = 0.06
"""Scale of the robust loss at the last step, and standard deviation of a point's distance in the likelihood, metres."""
POINT_SIGMA_M = 0.5 * NARROW_SCALE_M
"""Standard deviation of a point's distance, metres; wide, as errors of neighbours are correlated."""
EXPLAINED_M = 0.10
"""Distance, in metres, up to which a point lies on its surface."""
WIDE_SCALE_M = 5.0 * NARROW_SCALE_M
"""Scale of the robust loss at the first step, metres, if the guess is that of odometry."""
SEEN_NATS = 0.5
"""Log-likelihood that a scan loses at least where it is displaced in a direction that it sees: that of one standard
deviation."""


Diagonal = tuple[float, float, float]
"""Diagonal elements over (x, y, theta)."""


class ScanMatch(NamedTuple):
    """Pose of a scan in a field."""

    T_field_base: FloatArray
    information: FloatArray
    """Information of the points without the prior, over (x, y) in the field and theta, shape (3, 3)."""
    explained: float
    known: float
    """Shares of the scan's points that lie on a surface, and that fall near any."""
    log_likelihoods: FloatArray
    """Log-likelihood of each point, relative to one on no surface, shape (N,).

    Each point lies on its nearest surface, with a normally distributed distance, or is an outlier. Errors of
    neighbouring points are correlated, so each counts as a share.
    """
    velocity: FloatArray
    """Correction of the velocity in the sweep, in ``base``, shape (3,), m/s and rad/s; zeros for a scan at once."""
    log_likelihood: float
    """Log-likelihood of the scan, relative to a scan without a point on a surface."""


def match_scan(
    scan: PointScan,
    field: SurfelField,
    T_field_guess: FloatArray,
    prior_information: FloatArray,
    velocity_information: FloatArray = FIXED,
    wide_scale_m: float = WIDE_SCALE_M,
    clutter_scale_m: float = NARROW_SCALE_M,
    prior_tail: float = math.inf,
) -> ScanMatch:
    """Find the pose that minimises the robust distances of the points to the field, with a prior at the guess.

    The points of a sweep were measured at different times, and their positions assume a motion. Its velocity is
    corrected together with the pose: a point of time t moves by t times the correction. This is continuous-time
    matching as in Dellenbach et al., "CT-ICP", ICRA 2022, with one velocity for a scan.

    Args:
        scan, field: points in ``base``, and surfaces.
        T_field_guess: start, and mean of the prior, shape (3,), metres and radians.
        prior_information: over (x, y, theta) in the field's coordinates, shape (3, 3); zeros for no prior.
        velocity_information: of the assumed velocity (x, y, theta), shape (3,), in (m/s)^-2 and (rad/s)^-2.
        wide_scale_m: scale of the robust loss at the first step, metres.
        clutter_scale_m: least scale of the loss of points without a normal, metres.
        prior_tail: degrees of freedom of the prior, a Student t distribution of the position and one of the heading;
            infinity for a normal distribution.
    """
    return ScanMatch(
        *_match(
            _Points(scan.points, scan.normals, scan.solitary, scan.origin, scan.times_s),
            np.array(T_field_guess),  # a writable copy: code is compiled once
            prior_information,
            velocity_information,
            field.arrays,
            wide_scale_m,
            clutter_scale_m,
            prior_tail,
        )
    )


def seen_information(scan: PointScan, field: SurfelField, match: ScanMatch) -> FloatArray:
    """Information (3, 3) of a match, without a direction that the scan does not see, as the axis of a bare corridor.

    There, noise of the normals makes the second derivative of the cost, and a scan that is displaced by
    ``WIDE_SCALE_M`` fits as well. Returns in a row without a normal do not count: far along a wall, they repeat the
    pattern of the beams.
    """
    weakest = np.linalg.eigh(match.information[:2, :2])[1][:, 0]
    points = _Points(scan.points, scan.normals, scan.solitary, scan.origin, scan.times_s)
    counts = scan.normals.any(axis=1) | scan.solitary
    at, before, behind = (
        _fit(points, match.T_field_base + np.append(shift_m * weakest, 0.0), np.zeros(3), field.arrays)[2][counts].sum()
        for shift_m in (0.0, -WIDE_SCALE_M, WIDE_SCALE_M)
    )
    if at - max(before, behind) >= SEEN_NATS:
        return match.information
    seen = np.eye(3)
    seen[:2, :2] -= np.outer(weakest, weakest)
    return np.asarray(seen @ match.information @ seen)


class _Points(NamedTuple):
    points: FloatArray
    normals: FloatArray
    solitary: NDArray[np.bool_]
    origin: FloatArray
    times: FloatArray


class _Loss(NamedTuple):
    scale: float  # metres
    clutter: float  # the same for points without a normal
    new_weight: float  # of points on new surfaces


@njit
def _match(scan, guess, prior, velocity_prior, field, wide, clutter, tail):  # type: ignore[no-untyped-def]
    """Gauss-Newton while the scale of the loss shrinks from ``wide`` to ``NARROW_SCALE_M``, in clutter to ``clutter``.

    It minimises sum_i rho(e_i)^2 / sigma^2 + tail log(1 + d^2 / tail) + p_x v_x^2 + p_y v_y^2
    + log(1 + p_theta v_theta^2), with d^2 = (pose - guess)^T prior (pose - guess), for position and heading apart if
    the tail is finite, and with p the ``velocity_prior``: a robot that drives straight may begin to turn within a
    scan, so the prior of the turn rate has the tails of Cauchy's distribution. The Jacobian of e_i over pose and
    velocity v is (J_i, t_i J_i). So the normal equations have sums of J^T J, t J^T J and t^2 J^T J. The Schur
    complement eliminates v.
    """
    pose, velocity = guess.copy(), np.zeros(3)
    H, g, mixed, own, reduced = np.empty((3, 3)), np.empty(3), np.empty((3, 3)), np.empty((3, 3)), np.zeros((4, 3))
    equations = H, g, mixed, own, reduced
    new_weight = _weight_of_new(scan, pose, field)
    scale = wide
    for _ in range(MOST_ITERATIONS):
        loss = _Loss(scale, max(scale, clutter), new_weight)
        _normal_equations(equations, scan, pose, velocity, field, loss, velocity_prior)
        turned = (pose[2] - guess[2] + np.pi) % (2.0 * np.pi) - np.pi
        difference = pose[0] - guess[0], pose[1] - guess[1], turned
        squared = prior[0, 0] * difference[0] ** 2 + prior[1, 1] * difference[1] ** 2
        position = 1.0 / (1.0 + squared / tail)
        heading = 1.0 / (1.0 + prior[2, 2] * turned**2 / tail)
        for r in range(3):
            for c in range(3):
                weighted = prior[r, c] * (heading if max(r, c) == 2 else position)
                g[r] += weighted * difference[c]
                H[r, c] += weighted
            H[r, r] += DAMPING
        step = _solve(H, g)
        small = abs(step[0]) + abs(step[1]) < SMALL_STEP_M and abs(step[2]) < SMALL_STEP_RAD
        for r in range(3):
            pose[r] -= step[r]
        if len(scan.times) > 0:
            for r in range(3):
                velocity[r] -= (
                    reduced[3, r] - reduced[0, r] * step[0] - reduced[1, r] * step[1] - reduced[2, r] * step[2]
                )
        if small and scale <= NARROW_SCALE_M:
            break
        scale = max(NARROW_SCALE_M, scale * (FAST_SHRINK if small else SHRINK))
    pose[2] = (pose[2] + np.pi) % (2.0 * np.pi) - np.pi
    loss = _Loss(NARROW_SCALE_M, NARROW_SCALE_M, 1.0)
    _normal_equations(equations, scan, pose, velocity, field, loss, velocity_prior)
    explained, known, log_likelihoods, total = _fit(scan, pose, velocity, field)
    cos, sin = np.cos(pose[2]), np.sin(pose[2])
    x, y = velocity[0], velocity[1]
    velocity[0], velocity[1] = cos * x + sin * y, cos * y - sin * x
    return pose, H, explained, known, log_likelihoods, velocity, total


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


@njit(allocates=False)
def _normal_equations(equations, scan, pose, velocity, field, loss, velocity_prior):  # type: ignore[no-untyped-def]
    """Write the normal equations over the pose, without the velocity, in units of ``POINT_SIGMA_M``, into H and g.

    ``mixed`` is the block of pose and velocity, ``own`` that of the velocity, with its prior. The velocity that
    minimises the cost is moved by row 3 of ``reduced`` (4, 3) less the step of the pose times rows 0 to 2.
    """
    H, g, mixed, own, reduced = equations
    own_pose, mixed_sums, own_velocity, moment, velocity_moment = _sums(scan, pose, velocity, field, loss)
    s2 = 1.0 / (POINT_SIGMA_M * POINT_SIGMA_M)
    _scale_symmetric(H, s2, own_pose)
    for r in range(3):
        g[r] = s2 * moment[r]
    if len(scan.times) == 0:
        return
    _scale_symmetric(mixed, s2, mixed_sums)
    _scale_symmetric(own, s2, own_velocity)
    for r in range(3):
        weight = velocity_prior[r]
        if r == 2:
            weight /= 1.0 + velocity_prior[r] * velocity[r] * velocity[r]
        own[r, r] += weight + DAMPING
        reduced[3, r] = s2 * velocity_moment[r] + weight * velocity[r]
    reduced[3, 0], reduced[3, 1], reduced[3, 2] = _solve(own, reduced[3])
    for r in range(3):
        reduced[r, 0], reduced[r, 1], reduced[r, 2] = _solve(own, mixed[r])
    for r in range(3):
        g[r] -= mixed[r, 0] * reduced[3, 0] + mixed[r, 1] * reduced[3, 1] + mixed[r, 2] * reduced[3, 2]
        for c in range(3):
            H[r, c] -= mixed[r, 0] * reduced[c, 0] + mixed[r, 1] * reduced[c, 1] + mixed[r, 2] * reduced[c, 2]


@njit(allocates=False)
def _weight_of_new(scan, pose, field):  # type: ignore[no-untyped-def]
    """Weight of a point on a new surface: below 1 where most points are on such surfaces.

    A new surface lies where the last few poses have put it, and its points confirm these poses. Where most points are
    on such surfaces, as behind a corner or beside a hedge, small errors add up from scan to scan.
    """
    if field.surfels.shape[1] <= MERGED or field.used[2] <= NEW_MOTION:
        return 1.0
    cos, sin = np.cos(pose[2]), np.sin(pose[2])
    old = new = 0
    for point in scan.points:
        x, y = pose[0] + cos * point[0] - sin * point[1], pose[1] + sin * point[0] + cos * point[1]
        label = label_at(x, y, field)
        if label == EMPTY:
            continue
        if _is_new(field.surfels[label], field):
            new += 1
        else:
            old += 1
    return 1.0 if new <= MOST_NEW * old else max(LEAST_NEW_WEIGHT, MOST_NEW * old / new)


@njit(allocates=False)
def _is_new(surfel, field):  # type: ignore[no-untyped-def]
    return surfel[FIRST_SEEN] > field.used[2] - NEW_MOTION


@njit(allocates=False)
def _scale_symmetric(matrix, factor, upper):  # type: ignore[no-untyped-def]
    """Write ``factor`` times a symmetric matrix, given by its upper triangle, into ``matrix``."""
    xx, xy, xt, yy, yt, tt = upper
    matrix[0, 0], matrix[1, 1], matrix[2, 2] = factor * xx, factor * yy, factor * tt
    matrix[0, 1] = matrix[1, 0] = factor * xy
    matrix[0, 2] = matrix[2, 0] = factor * xt
    matrix[1, 2] = matrix[2, 1] = factor * yt


@njit(allocates=False)
def _sums(scan, pose, velocity, field, loss):  # type: ignore[no-untyped-def]
    """Sums over the points of w J^T J, t w J^T J, t^2 w J^T J (upper triangles), w J^T e and t w J^T e."""
    hxx = hxy = hxt = hyy = hyt = htt = gx = gy = gt = 0.0  # scalars, which stay in registers
    kxx = kxy = kxt = kyy = kyt = ktt = fx = fy = ft = 0.0
    lxx = lxy = lxt = lyy = lyt = ltt = 0.0
    cos, sin = np.cos(pose[2]), np.sin(pose[2])
    swept = len(scan.times) > 0
    for i in range(len(scan.points)):
        t = scan.times[i] if swept else 0.0
        axx, axy, axt, ayy, ayt, att, bx, by, bt = _terms(scan, i, pose, cos, sin, t, velocity, field, loss)
        hxx, hxy, hxt, hyy, hyt, htt = hxx + axx, hxy + axy, hxt + axt, hyy + ayy, hyt + ayt, htt + att
        gx, gy, gt = gx + bx, gy + by, gt + bt
        if swept:
            kxx, kxy, kxt, kyy = kxx + t * axx, kxy + t * axy, kxt + t * axt, kyy + t * ayy
            kyt, ktt, fx, fy, ft = kyt + t * ayt, ktt + t * att, fx + t * bx, fy + t * by, ft + t * bt
            lxx, lxy, lxt = lxx + t * t * axx, lxy + t * t * axy, lxt + t * t * axt
            lyy, lyt, ltt = lyy + t * t * ayy, lyt + t * t * ayt, ltt + t * t * att
    return (
        (hxx, hxy, hxt, hyy, hyt, htt),
        (kxx, kxy, kxt, kyy, kyt, ktt),
        (lxx, lxy, lxt, lyy, lyt, ltt),
        (gx, gy, gt),
        (fx, fy, ft),
    )


@njit(allocates=False)
def _terms(scan, i, pose, cos, sin, t, velocity, field, loss):  # type: ignore[no-untyped-def]
    """w J^T J (upper triangle) and w J^T e of point i, measured at t.

    e is the distance from the point to the line of its surfel. Its Jacobian over the pose is J = (n_x, n_y, n x r),
    with the normal n and the point r relative to the robot. A solitary return has two residuals, the distances along x
    and along y. The weight w is that of Geman and McClure, less on new surfaces.
    """
    none = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    rx, ry = _swept_point(scan.points, i, cos, sin, t, velocity)
    x, y = pose[0] + rx, pose[1] + ry
    label = label_at(x, y, field)
    if label == EMPTY:
        return none
    s = field.surfels[label]
    dx, dy = x - s[0], y - s[1]
    nx, ny = s[2], s[3]
    mx = cos * scan.normals[i, 0] - sin * scan.normals[i, 1]
    my = sin * scan.normals[i, 0] + cos * scan.normals[i, 1]
    if nx * mx + ny * my < OPPOSED:  # the two sides of a thin wall do not attract each other
        return none
    d2 = dx * dx + dy * dy
    weight = loss.new_weight if loss.new_weight < 1.0 and _is_new(s, field) else 1.0
    if nx == 0.0 and ny == 0.0:
        nx, ny = mx, my
    if nx == 0.0 and ny == 0.0:
        c2 = loss.clutter * loss.clutter
        w = weight * NO_NORMAL_WEIGHT * (c2 / (c2 + d2)) ** 2
        if scan.solitary[i]:
            return w, 0.0, -w * ry, w, w * rx, w * (rx * rx + ry * ry), w * dx, w * dy, w * (rx * dy - ry * dx)
        # Far along a wall, returns in a row repeat the pattern of the beams: their range would bind the robot to its
        # previous position with false certainty. Only their bearing counts.
        bearing_x, bearing_y = scan.points[i, 0] - scan.origin[0], scan.points[i, 1] - scan.origin[1]
        length = max(np.hypot(bearing_x, bearing_y), 1e-9)
        nx = -(sin * bearing_x + cos * bearing_y) / length
        ny = (cos * bearing_x - sin * bearing_y) / length
        e = nx * dx + ny * dy
    else:
        e = nx * dx + ny * dy
        c2 = loss.scale * loss.scale
        w = weight * (c2 / (c2 + e * e + ALONG * max(0.0, d2 - e * e))) ** 2
    lever = ny * rx - nx * ry
    return (
        w * nx * nx,
        w * nx * ny,
        w * nx * lever,
        w * ny * ny,
        w * ny * lever,
        w * lever * lever,
        w * nx * e,
        w * ny * e,
        w * lever * e,
    )


@njit(allocates=False)
def _swept_point(points, i, cos, sin, t, velocity):  # type: ignore[no-untyped-def]
    """Point i relative to the robot, turned into the field and moved by the velocity during t."""
    rx = cos * points[i, 0] - sin * points[i, 1]
    ry = sin * points[i, 0] + cos * points[i, 1]
    return rx + t * (velocity[0] - velocity[2] * ry), ry + t * (velocity[1] + velocity[2] * rx)


@njit
def _fit(scan, pose, velocity, field):  # type: ignore[no-untyped-def]
    """Share of the points on a surface, share near any, the log-likelihood of each, shape (N,), and its sum."""
    points, normals, surfels = scan.points, scan.normals, field.surfels
    cos, sin = np.cos(pose[2]), np.sin(pose[2])
    explained = known = 0
    log_likelihoods, total = np.zeros(len(points)), 0.0
    swept = len(scan.times) > 0
    for i in range(len(points)):
        rx, ry = _swept_point(points, i, cos, sin, scan.times[i] if swept else 0.0, velocity)
        x, y = pose[0] + rx, pose[1] + ry
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
            on_surface = d2 < EXPLAINED_M * EXPLAINED_M
        else:
            e = s[2] * dx + s[3] * dy
            likely2 = e * e + ALONG * (d2 - e * e)
            on_surface = abs(e) < EXPLAINED_M and d2 <= ALONG_LIMIT2 * EXPLAINED_M * EXPLAINED_M
        if on_surface:
            explained += 1
        likelihood_ratio = INLIER_RATIO * np.exp(-0.5 * likely2 / (NARROW_SCALE_M * NARROW_SCALE_M))
        log_likelihoods[i] = INDEPENDENT * np.log1p(likelihood_ratio)
        total += log_likelihoods[i]
    n = max(1, len(points))
    return explained / n, known / n, log_likelihoods, total


def limited_information(points: FloatArray, heading_rad: float, prior: Diagonal, variance: Diagonal) -> FloatArray:
    """``((R' P R + diag(prior))^-1 + diag(variance))^-1``, shape (3, 3), over (x, y, theta) of the robot.

    It is the information of a motion that points measure, with a prior, limited by errors that more points do not
    reduce. ``points`` P is over (x, y) in a field and theta; writable, as code is compiled once. R is the robot's
    heading there. The ``prior`` is positive, and ``variance`` the least one.
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
        inverse[0, c], inverse[1, c], inverse[2, c] = _solve(matrix, unit)
        unit[c] = 0.0
