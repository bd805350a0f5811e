"""Rigid alignment of matched points of the plane.

Two matched places fix the frame of one map in another (FC-SLAM, section III.C, eqs. 5 and 6). The paper prints eq. (6)
as ``x' = -D R D x``, with the translation D on both sides of R. This is not a rigid map between two frames. Its
homogeneous coordinate is -1, and with it divided out the translation counts twice. The corrected form is
``x' = D R x``.
"""

import numpy as np
from numpy.typing import ArrayLike

from fcslam.geometry.se2 import Array

_DEGENERATE = 1e-12
"""Sum behind the rotation, relative to the squared spread of both sets of points, below which no rotation is best."""
_ROUNDING = 1e-28
"""Squared spread of points, relative to their squared coordinates, below which it is rounding: they are one point."""


def rotation_eq5(alpha_rad: float) -> Array:
    """Homogeneous rotation matrix of the paper, shape (3, 3); with its signs it rotates by ``-alpha_rad``."""
    cos, sin = np.cos(alpha_rad), np.sin(alpha_rad)
    return np.array([[cos, sin, 0.0], [-sin, cos, 0.0], [0.0, 0.0, 1.0]])  # eq. (5)


def two_point_alignment(points_a: ArrayLike, points_b: ArrayLike) -> Array:
    """Compute ``T_a_b`` from two matched points by eqs. (5) and (6) of FC-SLAM in their corrected form.

    Args:
        points_a: shape (2, 2), metres, in the coordinate frame a (the paper's x').
        points_b: the same points in the coordinate frame b (the paper's x); the midpoints coincide.

    Returns:
        ``T_a_b``, shape (3,), metres and radians.
    """
    a, b = np.asarray(points_a, dtype=np.float64), np.asarray(points_b, dtype=np.float64)
    if _coincide(a) or _coincide(b):
        raise ValueError("two coincident points determine no rotation")
    side_a, side_b = a[1] - a[0], b[1] - b[0]
    alpha = np.arctan2(side_b[1], side_b[0]) - np.arctan2(side_a[1], side_a[0])
    R = rotation_eq5(alpha)[:2, :2]
    # eq. (6), corrected: x' = R x + (dx, dy)
    dx, dy = a.mean(axis=0) - R @ b.mean(axis=0)
    return np.array([dx, dy, np.arctan2(R[1, 0], R[0, 0])])


def n_point_alignment(points_a: ArrayLike, points_b: ArrayLike, weights: ArrayLike | None = None) -> Array:
    """Compute the least-squares ``T_a_b`` over matched points in closed form.

    Minimises ``sum w |a - T_a_b b|^2`` (Umeyama 1991 without scale; here the rotation is the angle of a complex sum).

    Args:
        points_a: shape (..., N, 2), metres, in the coordinate frame a.
        points_b: the same points in the coordinate frame b, shape (..., N, 2), metres.
        weights: not negative, shape (..., N); None: all are 1.

    Returns:
        Poses, shape (..., 3), metres and radians; NaN if the points determine no rotation (all coincide, or fewer than
        two have a weight).
    """
    a, b = np.asarray(points_a, dtype=np.float64), np.asarray(points_b, dtype=np.float64)
    if a.shape != b.shape:
        raise ValueError(f"matched points have one shape (..., N, 2), not {a.shape} and {b.shape}")
    w = np.ones(a.shape[:-1]) if weights is None else np.asarray(weights, dtype=np.float64)
    a, b = a[..., 0] + 1j * a[..., 1], b[..., 0] + 1j * b[..., 1]
    with np.errstate(invalid="ignore", divide="ignore"):
        total = w.sum(axis=-1, keepdims=True)
        mean_a, mean_b = (w * a).sum(axis=-1, keepdims=True) / total, (w * b).sum(axis=-1, keepdims=True) / total
        from_a, from_b = a - mean_a, b - mean_b
        turn = (w * from_a * np.conj(from_b)).sum(axis=-1)
    spread, size = ((w * (np.abs(p) ** 2 + np.abs(q) ** 2)).sum(axis=-1) for p, q in ((from_a, from_b), (a, b)))
    theta = np.angle(turn)
    shift = mean_a[..., 0] - np.exp(1j * theta) * mean_b[..., 0]
    pose = np.stack((shift.real, shift.imag, theta), axis=-1)
    is_determined = np.abs(turn) > np.maximum(_DEGENERATE * spread, _ROUNDING * size)
    return np.where(is_determined[..., None], pose, np.nan)


def _coincide(points: Array) -> bool:
    side = points[1] - points[0]
    return bool(side @ side <= _ROUNDING * (points * points).sum())
