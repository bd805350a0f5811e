"""The groups of rigid motions, SE(2) and SE(3), as one kind of value: functions of arrays with one pose each row.

What is true of rigid motions is written once, with the group as an argument or as that of its poses (``group_of``).
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fcslam.geometry import se2, se3
from fcslam.records import frozen

_Array = NDArray[np.float64]


class Group(NamedTuple):
    """A group of rigid motions; ``T_a_b`` takes coordinates in b to a."""

    identity: _Array
    """Shape (P,)."""
    freedom: int
    """Degrees of freedom d, the size of a tangent."""
    chi2_limit: float
    """Chi-square with d degrees of freedom that the error of a true measurement has with a probability of 0.99."""
    compose: Callable[[Any, Any], _Array]
    """``T_a_c`` of ``T_a_b`` and ``T_b_c``."""
    inverse: Callable[[Any], _Array]
    between: Callable[[Any, Any], _Array]
    """``T_b_c`` of ``T_a_b`` and ``T_a_c``."""
    exp: Callable[[Any], _Array]
    log: Callable[[Any], _Array]
    log_jacobian: Callable[[Any], _Array]
    """Matrix J with ``log(exp(v) exp(d)) = v + J d`` to first order in d, shape (..., d, d)."""
    adjoint: Callable[[Any], _Array]
    """Matrix Ad with ``T exp(v) T^-1 = exp(Ad v)``, shape (..., d, d)."""
    to_plane: Callable[[Any], _Array]
    """x, y and heading, shape (..., 3)."""
    from_plane: Callable[[Any], _Array]
    """The pose of x, y and heading, level at height 0."""
    planar_information: Callable[[Any], _Array]
    """Information (..., 3, 3) of x, y and heading, whatever the others are, of an information (..., d, d)."""
    shift_m: Callable[[Any], Any]
    """Length of the translation of a motion (..., P), metres, shape (...)."""
    turn_rad: Callable[[Any], Any]
    """Angle of the rotation of a motion (..., P), radians, shape (...)."""

    @property
    def axes(self) -> int:
        """Axes of a position: the first numbers of a pose and of a tangent."""
        return 2 if self.freedom == 3 else 3

    def sigmas(self, sigma_m: float, sigma_rad: float) -> _Array:
        """Standard deviations of a tangent, shape (d,), equal in all directions and about all axes."""
        return np.array([*self.axes * [sigma_m], *(self.freedom - self.axes) * [sigma_rad]])

    @property
    def size(self) -> int:
        """Numbers of a pose."""
        return len(self.identity)

    def residual(self, T_i_j: _Array, x_i: _Array, x_j: _Array) -> _Array:
        """``r = log(T^-1 x_i^-1 x_j)`` of measurements T and poses x_i and x_j, shape (E, d)."""
        return self.log(self.between(T_i_j, self.between(x_i, x_j)))

    def jacobians(self, residual: _Array, x_i: _Array, x_j: _Array) -> tuple[_Array, _Array]:
        """Jacobians ``A``, ``B`` by x_i and x_j, shape (E, d, d); a step changes the residual by ``A d_i + B d_j``."""
        of_j = self.log_jacobian(residual)
        return -of_j @ self.adjoint(self.between(x_j, x_i)), of_j

    def retract(self, poses: _Array, step: _Array) -> _Array:
        """``x exp(d)`` of poses x and a step d, shape (N, d)."""
        return self.compose(poses, self.exp(step))


def _planar(values: _Array) -> _Array:
    return values


SE2 = Group(
    se2.IDENTITY,
    3,
    11.344866730144373,
    se2.compose,
    se2.inverse,
    se2.between,
    se2.exp,
    se2.log,
    se2.log_jacobian,
    se2.adjoint,
    _planar,
    _planar,
    _planar,
    se2.shift_m,
    se2.turn_rad,
)
SE3 = Group(
    se3.IDENTITY,
    6,
    16.811893829770927,
    se3.compose,
    se3.inverse,
    se3.between,
    se3.exp,
    se3.log,
    se3.log_jacobian,
    se3.adjoint,
    se3.to_plane,
    se3.from_plane,
    se3.planar_information,
    se3.shift_m,
    se3.turn_rad,
)


def group_of(poses: _Array) -> Group:
    """The group of poses (..., P) by their size: (x, y, theta), or (x, y, z, qx, qy, qz, qw)."""
    return SE2 if poses.shape[-1] == SE2.size else SE3


def compose(T_a_b: _Array, T_b_c: _Array) -> _Array:
    """``T_a_c`` in the group of the poses, or in space if only one of them is in the plane."""
    if T_a_b.shape[-1] == T_b_c.shape[-1]:
        return group_of(T_a_b).compose(T_a_b, T_b_c)
    return SE3.compose(to_space(T_a_b), to_space(T_b_c))


def to_space(poses: _Array) -> _Array:
    """Poses (..., P) as poses (..., 7) of SE(3)."""
    return poses if poses.shape[-1] == SE3.size else SE3.from_plane(poses)


def by_dimensions(poses: _Array) -> tuple[_Array, _Array | None]:
    """Read-only poses (..., 3) in the plane, and those (..., 7) in space; None: they are in the plane."""
    group, poses = group_of(poses), frozen(poses)
    return (poses, None) if group is SE2 else (frozen(group.to_plane(poses)), poses)
