"""Rigid alignment of matched points of the plane."""

import numpy as np
from numpy.typing import ArrayLike

from fcslam.geometry.se2 import Array

_DEGENERATE = 1e-12
"""Sum behind the rotation, relative to the squared spread of both sets of points, below which no rotation is best."""
ROUNDING = 1e-28
"""Squared spread of points, relative to their squared coordinates, below which it is rounding: they are one point."""


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
    is_determined = np.abs(turn) > np.maximum(_DEGENERATE * spread, ROUNDING * size)
    return np.where(is_determined[..., None], pose, np.nan)
