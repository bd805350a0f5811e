"""The group SE(2) of rigid motions of the plane, on plain arrays.

A pose is ``(x, y, theta)`` in metres and radians, shape (..., 3), float64. ``T_a_b`` takes coordinates in b to a,
so ``compose(T_a_b, T_b_c)`` is ``T_a_c``. Every function but ``motion`` broadcasts over the leading dimensions. Single
poses, the common case in the hot loops, have their own code path: numpy's overhead is twenty times the arithmetic.
"""

import math
from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]
Pose = tuple[float, float, float]
"""A single pose as numbers."""
_TURN = 2.0 * math.pi

IDENTITY: Array = np.zeros(3)
IDENTITY.setflags(write=False)


def wrap_angle(angle_rad: ArrayLike) -> Any:
    """Angle in [-pi, pi], the same direction as ``angle_rad``; shape kept."""
    return (np.asarray(angle_rad, dtype=np.float64) + np.pi) % (2.0 * np.pi) - np.pi


def compose(T_a_b: ArrayLike, T_b_c: ArrayLike) -> Array:
    """``T_a_c``, shape (..., 3)."""
    a, b = np.asarray(T_a_b, dtype=np.float64), np.asarray(T_b_c, dtype=np.float64)
    if a.ndim == 1 and b.ndim == 1:
        return np.array(_compose_one(a.tolist(), b.tolist()))
    cos, sin = np.cos(a[..., 2]), np.sin(a[..., 2])
    x = a[..., 0] + cos * b[..., 0] - sin * b[..., 1]
    y = a[..., 1] + sin * b[..., 0] + cos * b[..., 1]
    return np.stack(np.broadcast_arrays(x, y, wrap_angle(a[..., 2] + b[..., 2])), axis=-1)


def inverse(T_a_b: ArrayLike) -> Array:
    """``T_b_a``, shape (..., 3)."""
    a = np.asarray(T_a_b, dtype=np.float64)
    if a.ndim == 1:
        return np.array(_inverse_one(a.tolist()))
    cos, sin = np.cos(a[..., 2]), np.sin(a[..., 2])
    x = -cos * a[..., 0] - sin * a[..., 1]
    y = sin * a[..., 0] - cos * a[..., 1]
    return np.stack((x, y, wrap_angle(-a[..., 2])), axis=-1)


def between(T_a_b: ArrayLike, T_a_c: ArrayLike) -> Array:
    """``T_b_c = T_a_b^-1 T_a_c``, shape (..., 3)."""
    a, c = np.asarray(T_a_b, dtype=np.float64), np.asarray(T_a_c, dtype=np.float64)
    if a.ndim == 1 and c.ndim == 1:
        return np.array(motion(a, c))
    cos, sin = np.cos(a[..., 2]), np.sin(a[..., 2])
    dx, dy = c[..., 0] - a[..., 0], c[..., 1] - a[..., 1]
    turn = wrap_angle(c[..., 2] - a[..., 2])
    return np.stack(np.broadcast_arrays(cos * dx + sin * dy, cos * dy - sin * dx, turn), axis=-1)


def shift_m(T_a_b: ArrayLike) -> Any:
    """Length of the translation, metres, shape (...)."""
    T = np.asarray(T_a_b, dtype=np.float64)
    return np.hypot(T[..., 0], T[..., 1])


def turn_rad(T_a_b: ArrayLike) -> Any:
    """Angle of the rotation, radians, shape (...)."""
    return np.abs(np.asarray(T_a_b, dtype=np.float64)[..., 2])


def motion(T_a_b: Array, T_a_c: Array) -> Pose:
    """``between`` of two single poses, shape (3,), as numbers."""
    (x, y, theta), (u, v, phi) = T_a_b.tolist(), T_a_c.tolist()
    cos, sin, dx, dy = math.cos(theta), math.sin(theta), u - x, v - y
    return cos * dx + sin * dy, cos * dy - sin * dx, (phi - theta + math.pi) % _TURN - math.pi


def transform(T_a_b: ArrayLike, points_b: ArrayLike) -> Array:
    """Transform points (..., N, 2) from b to a, metres; the pose has shape (..., 3)."""
    pose, points = np.asarray(T_a_b, dtype=np.float64), np.asarray(points_b, dtype=np.float64)
    cos, sin = np.cos(pose[..., 2:3]), np.sin(pose[..., 2:3])
    x = pose[..., 0:1] + cos * points[..., 0] - sin * points[..., 1]
    y = pose[..., 1:2] + sin * points[..., 0] + cos * points[..., 1]
    return np.stack((x, y), axis=-1)


def exp(tangent: ArrayLike) -> Array:
    """Exponential map of the twist (v_x, v_y, omega), shape (..., 3)."""
    v = np.asarray(tangent, dtype=np.float64)
    omega = v[..., 2]
    a, b = _sinc_terms(omega)
    return np.stack((a * v[..., 0] - b * v[..., 1], b * v[..., 0] + a * v[..., 1], wrap_angle(omega)), axis=-1)


def log(T_a_b: ArrayLike) -> Array:
    """Twist (v_x, v_y, omega) whose exponential is the pose; |omega| <= pi; shape (..., 3)."""
    pose = np.asarray(T_a_b, dtype=np.float64)
    omega = wrap_angle(pose[..., 2])
    a, b = _sinc_terms(omega)
    scale = a * a + b * b
    vx = (a * pose[..., 0] + b * pose[..., 1]) / scale
    vy = (-b * pose[..., 0] + a * pose[..., 1]) / scale
    return np.stack((vx, vy, omega), axis=-1)


def log_jacobian(tangent: ArrayLike) -> Array:
    """Matrix J with ``log(exp(v) exp(d)) = v + J d`` to first order in d, shape (..., 3, 3); v of shape (..., 3)."""
    v = np.asarray(tangent, dtype=np.float64)
    half = v[..., 2] / 2.0
    small = np.abs(half) < 1e-3
    safe = np.where(small, 1.0, half)
    a = np.where(small, 1.0 - half * half / 3.0, safe / np.tan(safe))
    b = np.where(small, half / 6.0, (1.0 - a) / (2.0 * safe))
    x, y = b * v[..., 0] + v[..., 1] / 2.0, b * v[..., 1] - v[..., 0] / 2.0
    zero = np.zeros_like(half)
    rows = ((a, -half, x), (half, a, y), (zero, zero, zero + 1.0))
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def adjoint(T_a_b: ArrayLike) -> Array:
    """Matrix Ad with ``T exp(v) T^-1 = exp(Ad v)``, shape (..., 3, 3)."""
    pose = np.asarray(T_a_b, dtype=np.float64)
    cos, sin = np.cos(pose[..., 2]), np.sin(pose[..., 2])
    zero, one = np.zeros_like(cos), np.ones_like(cos)
    rows = ((cos, -sin, pose[..., 1]), (sin, cos, -pose[..., 0]), (zero, zero, one))
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def relative(poses: ArrayLike) -> Array:
    """Motions between consecutive poses of a chain: (N, 3) to (N - 1, 3)."""
    chain = np.asarray(poses, dtype=np.float64)
    return between(chain[:-1], chain[1:])


def _compose_one(T_a_b: Iterable[float], T_b_c: Iterable[float]) -> Pose:
    (x, y, theta), (dx, dy, turn) = T_a_b, T_b_c
    cos, sin = math.cos(theta), math.sin(theta)
    return x + cos * dx - sin * dy, y + sin * dx + cos * dy, _wrap_one(theta + turn)


def _inverse_one(T_a_b: Iterable[float]) -> Pose:
    x, y, theta = T_a_b
    cos, sin = math.cos(theta), math.sin(theta)
    return -cos * x - sin * y, sin * x - cos * y, _wrap_one(-theta)


def _wrap_one(angle_rad: float) -> float:
    return (angle_rad + math.pi) % _TURN - math.pi


def _sinc_terms(omega: Array) -> tuple[Array, Array]:
    """``sin(w)/w`` and ``(1 - cos(w))/w``, by their series near zero."""
    small = np.abs(omega) < 1e-5
    safe = np.where(small, 1.0, omega)
    a = np.where(small, 1.0 - omega * omega / 6.0, np.sin(safe) / safe)
    b = np.where(small, omega / 2.0, (1.0 - np.cos(safe)) / safe)
    return a, b
