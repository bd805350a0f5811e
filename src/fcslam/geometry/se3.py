"""The group SE(3) of rigid motions of space, on plain arrays: the functions of ``se2`` with six degrees of freedom.

A pose is ``(x, y, z, qx, qy, qz, qw)``, metres and a unit quaternion with ``qw >= 0``, shape (..., 7), float64: the
order of TUM files. ``T_a_b`` takes coordinates in b to a. A tangent is ``(v_x, v_y, v_z, r_x, r_y, r_z)``, metres and
radians, in the frame of the body. Every function broadcasts over the leading dimensions.
"""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

IDENTITY: Array = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0])
IDENTITY.setflags(write=False)

_SMALL_RAD = 0.05
"""Angle below which series replace quotients, to 1e-13."""


def compose(T_a_b: ArrayLike, T_b_c: ArrayLike) -> Array:
    """``T_a_c``, shape (..., 7)."""
    a, b = _pose(T_a_b), _pose(T_b_c)
    return _joined(a[..., :3] + _rotated(a[..., 3:], b[..., :3]), _product(a[..., 3:], b[..., 3:]))


def inverse(T_a_b: ArrayLike) -> Array:
    """``T_b_a``, shape (..., 7)."""
    a = _pose(T_a_b)
    back = a[..., 3:] * (-1.0, -1.0, -1.0, 1.0)
    return _joined(-_rotated(back, a[..., :3]), back)


def between(T_a_b: ArrayLike, T_a_c: ArrayLike) -> Array:
    """``T_b_c = T_a_b^-1 T_a_c``, shape (..., 7)."""
    a, c = _pose(T_a_b), _pose(T_a_c)
    back = a[..., 3:] * (-1.0, -1.0, -1.0, 1.0)
    return _joined(_rotated(back, c[..., :3] - a[..., :3]), _product(back, c[..., 3:]))


def transform(T_a_b: ArrayLike, points_b: ArrayLike) -> Array:
    """Transform points (..., N, 3) from b to a, metres; the pose has shape (..., 7)."""
    pose, points = _pose(T_a_b), np.asarray(points_b, dtype=np.float64)
    moved: Array = points @ np.swapaxes(rotation(pose), -1, -2) + pose[..., None, :3]
    return moved


def rotation(T_a_b: ArrayLike) -> Array:
    """Rotation matrix of the pose, shape (..., 3, 3)."""
    x, y, z, w = np.moveaxis(_pose(T_a_b)[..., 3:], -1, 0)
    rows = (
        (1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - z * w), 2.0 * (x * z + y * w)),
        (2.0 * (x * y + z * w), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - x * w)),
        (2.0 * (x * z - y * w), 2.0 * (y * z + x * w), 1.0 - 2.0 * (x * x + y * y)),
    )
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def from_matrix(homogeneous: ArrayLike) -> Array:
    """Pose of a homogeneous matrix (..., 4, 4), shape (..., 7)."""
    m = np.asarray(homogeneous, dtype=np.float64)
    r = m[..., :3, :3]
    xx, yy, zz = r[..., 0, 0], r[..., 1, 1], r[..., 2, 2]
    x, y, z = r[..., 2, 1] - r[..., 1, 2], r[..., 0, 2] - r[..., 2, 0], r[..., 1, 0] - r[..., 0, 1]
    xy, xz, yz = r[..., 0, 1] + r[..., 1, 0], r[..., 0, 2] + r[..., 2, 0], r[..., 1, 2] + r[..., 2, 1]
    rows = (  # 4 q q^T: its longest row is the quaternion, free of cancellation
        (1.0 + xx - yy - zz, xy, xz, x),
        (xy, 1.0 - xx + yy - zz, yz, y),
        (xz, yz, 1.0 - xx - yy + zz, z),
        (x, y, z, 1.0 + xx + yy + zz),
    )
    outer = np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)
    longest = np.argmax(np.diagonal(outer, axis1=-2, axis2=-1), axis=-1)
    return _joined(m[..., :3, 3], np.take_along_axis(outer, longest[..., None, None], axis=-2)[..., 0, :])


def from_plane(T_a_b: ArrayLike) -> Array:
    """The pose (..., 3) of SE(2) as one of SE(3) in the plane z = 0, shape (..., 7)."""
    pose = np.asarray(T_a_b, dtype=np.float64)
    half, zero = pose[..., 2] / 2.0, np.zeros_like(pose[..., 2])
    quaternion = np.stack((zero, zero, np.sin(half), np.cos(half)), axis=-1)
    return _joined(np.stack((pose[..., 0], pose[..., 1], zero), axis=-1), quaternion)


def to_plane(T_a_b: ArrayLike) -> Array:
    """x, y and the heading of the pose's x axis in the plane of a: (..., 7) to (..., 3)."""
    pose = _pose(T_a_b)
    x, y, z, w = np.moveaxis(pose[..., 3:], -1, 0)
    heading = np.arctan2(2.0 * (x * y + z * w), 1.0 - 2.0 * (y * y + z * z))
    return np.stack((pose[..., 0], pose[..., 1], heading), axis=-1)


def exp(tangent: ArrayLike) -> Array:
    """Exponential map of the twist (v, r), shape (..., 6)."""
    twist = np.asarray(tangent, dtype=np.float64)
    v, r = twist[..., :3], twist[..., 3:]
    angle = np.linalg.norm(r, axis=-1, keepdims=True)
    small, safe = angle < _SMALL_RAD, np.where(angle < _SMALL_RAD, 1.0, angle)
    square = angle * angle
    half = np.where(small, 0.5 - square / 48.0 + square * square / 3840.0, np.sin(safe / 2.0) / safe)
    a = np.where(small, 0.5 - square / 24.0 + square * square / 720.0, (1.0 - np.cos(safe)) / safe**2)
    b = np.where(small, 1.0 / 6.0 - square / 120.0 + square * square / 5040.0, (safe - np.sin(safe)) / safe**3)
    turned = np.cross(r, v)
    return _joined(v + a * turned + b * np.cross(r, turned), np.concatenate((half * r, np.cos(angle / 2.0)), axis=-1))


def log(T_a_b: ArrayLike) -> Array:
    """Twist (v, r) whose exponential is the pose; |r| <= pi; shape (..., 6)."""
    pose = _pose(T_a_b)
    q = np.where(pose[..., 6:] < 0.0, -pose[..., 3:], pose[..., 3:])
    sine = np.linalg.norm(q[..., :3], axis=-1, keepdims=True)
    angle = 2.0 * np.arctan2(sine, q[..., 3:])
    small = angle < _SMALL_RAD
    ratio = 2.0 + sine * sine / 3.0 + 0.15 * sine**4 + 5.0 / 56.0 * sine**6  # 2 asin(s) / s
    r = q[..., :3] * np.where(small, ratio, angle / np.where(small, 1.0, sine))
    a, _ = _even_terms(angle)
    first = np.cross(r, pose[..., :3])
    # the inverse of V has the coefficient (1 - angle / 2 cot(angle / 2)) / angle^2 of its square
    square = np.where(
        small, a + angle * angle / 720.0, (1.0 - _half_cotangent(angle)) / np.where(small, 1.0, angle) ** 2
    )
    return np.concatenate((pose[..., :3] - first / 2.0 + square * np.cross(r, first), r), axis=-1)


def log_jacobian(tangent: ArrayLike) -> Array:
    """Matrix J with ``log(exp(v) exp(d)) = v + J d`` to first order in d, shape (..., 6, 6); v of shape (..., 6).

    J is x / (1 - exp(-x)) at the matrix x = ad(v), whose polynomial x (x^2 + angle^2)^2 vanishes: four powers suffice.
    """
    v = np.asarray(tangent, dtype=np.float64)
    first = np.zeros((*v.shape[:-1], 6, 6))
    first[..., :3, :3] = first[..., 3:, 3:] = _skew(v[..., 3:])
    first[..., :3, 3:] = _skew(v[..., :3])
    a, b = _even_terms(np.linalg.norm(v[..., 3:], axis=-1))
    second = first @ first
    jacobian: Array = np.eye(6) + first / 2.0 + a[..., None, None] * second + b[..., None, None] * (second @ second)
    return jacobian


def adjoint(T_a_b: ArrayLike) -> Array:
    """Matrix Ad with ``T exp(v) T^-1 = exp(Ad v)``, shape (..., 6, 6)."""
    pose = _pose(T_a_b)
    R = rotation(pose)
    matrix = np.zeros((*pose.shape[:-1], 6, 6))
    matrix[..., :3, :3] = matrix[..., 3:, 3:] = R
    matrix[..., :3, 3:] = _skew(pose[..., :3]) @ R
    return matrix


def planar_information(information: ArrayLike) -> Array:
    """Information (..., 3, 3) of x, y and heading, whatever the others are, of an information (..., 6, 6)."""
    covariance = np.linalg.inv(np.asarray(information, dtype=np.float64))[..., [[0], [1], [5]], [0, 1, 5]]
    return np.asarray(np.linalg.inv(covariance), np.float64)


def shift_m(T_a_b: ArrayLike) -> Any:
    """Length of the translation, metres, shape (...)."""
    return np.linalg.norm(np.asarray(T_a_b, dtype=np.float64)[..., :3], axis=-1)


def turn_rad(T_a_b: ArrayLike) -> Any:
    """Angle of the rotation, radians, shape (...)."""
    return 2.0 * np.arccos(np.clip(np.abs(np.asarray(T_a_b, dtype=np.float64)[..., 6]), 0.0, 1.0))


def _pose(values: ArrayLike) -> Array:
    return np.asarray(values, dtype=np.float64)


def _joined(position: Array, quaternion: Array) -> Array:
    """A pose of a position (..., 3) and a quaternion (..., 4) of any length but zero."""
    length = np.linalg.norm(quaternion, axis=-1, keepdims=True)
    return np.concatenate((position, quaternion / np.where(quaternion[..., 3:] < 0.0, -length, length)), axis=-1)


def _product(p: Array, q: Array) -> Array:
    """Product of quaternions (..., 4)."""
    px, py, pz, pw = np.moveaxis(p, -1, 0)
    qx, qy, qz, qw = np.moveaxis(q, -1, 0)
    return np.stack(
        (
            pw * qx + px * qw + py * qz - pz * qy,
            pw * qy - px * qz + py * qw + pz * qx,
            pw * qz + px * qy - py * qx + pz * qw,
            pw * qw - px * qx - py * qy - pz * qz,
        ),
        axis=-1,
    )


def _rotated(quaternion: Array, vector: Array) -> Array:
    """Vectors (..., 3) turned by quaternions (..., 4)."""
    x, y, z, w = np.moveaxis(quaternion, -1, 0)
    vx, vy, vz = np.moveaxis(vector, -1, 0)
    cx, cy, cz = 2.0 * (y * vz - z * vy), 2.0 * (z * vx - x * vz), 2.0 * (x * vy - y * vx)
    return np.stack(
        (vx + w * cx + y * cz - z * cy, vy + w * cy + z * cx - x * cz, vz + w * cz + x * cy - y * cx), axis=-1
    )


def _skew(v: Array) -> Array:
    """Matrix of the cross product with v, (..., 3) to (..., 3, 3)."""
    matrix = np.zeros((*v.shape[:-1], 3, 3))
    matrix[..., 0, 1], matrix[..., 0, 2], matrix[..., 1, 2] = -v[..., 2], v[..., 1], -v[..., 0]
    matrix[..., 1, 0], matrix[..., 2, 0], matrix[..., 2, 1] = v[..., 2], -v[..., 1], v[..., 0]
    return matrix


def _half_cotangent(angle: Array) -> Array:
    """``angle / 2 cot(angle / 2)``; 1 at small angles, where no caller uses it."""
    half = np.where(angle < _SMALL_RAD, 1.0, angle / 2.0)
    return np.where(angle < _SMALL_RAD, 1.0, half / np.tan(half))


def _even_terms(angle: Array) -> tuple[Array, Array]:
    """Coefficients a, b: ``1 + a x^2 + b x^4`` has the value and slope of ``x / 2 coth(x / 2)`` at x = i angle."""
    square, safe = angle * angle, np.where(angle < _SMALL_RAD, 1.0, angle)
    value = _half_cotangent(safe) - 1.0
    half = safe / 2.0
    slope = half / 2.0 / np.tan(half) - (half / np.sin(half)) ** 2 / 2.0  # angle / 2 times the slope by the angle
    small = angle < _SMALL_RAD
    b = np.where(small, -1.0 / 720.0 - square / 15120.0, (slope - value) / safe**4)
    return np.where(small, 1.0 / 12.0 - square * square / 30240.0, (slope - 2.0 * value) / safe**2), b
