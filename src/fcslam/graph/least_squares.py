"""Nonlinear least squares on a group of rigid motions: Levenberg-Marquardt with robust weights.

Edge k measures the motion T_k between variables i and j with information W_k. The cost of poses x is

    F(x) = 1/2 sum_k rho(s_k),    s_k = r_k^T W_k r_k,    r_k = log(T_k^-1 x_i^-1 x_j),

where rho(s) = s, or the loss of closures. If x_n moves to x_n exp(d_n), the residual is r_k + A_k d_i + B_k d_j to
first order. A step d minimises

    1/2 sum_k rho'(s_k) |r_k + A_k d_i + B_k d_j|^2_(W_k) + 1/2 damping |d|^2.
"""

from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from fcslam.geometry.groups import Group
from fcslam.graph.cholesky import find_structure, solve
from fcslam.graph.pose_graph import EdgeArrays
from fcslam.records import FloatArray

CAUCHY_WIDTH = 2.385
"""Width of the Cauchy loss in standard deviations: 95 % efficiency on normal residuals."""
TOLERANCE = 1e-6
"""Relative and absolute change of the cost at which Levenberg-Marquardt ends."""
_DAMPING, _DAMPING_STEP = 1e-5, 10.0
"""Damping at first, which hardly counts, and at most its inverse; its factor after failed steps, divisor after others.
"""
_LEAST_GAIN = 1e-3
"""Least decrease of the cost that a step needs, as a share of what the linear problem promises."""


class Loss(StrEnum):
    """Loss of the residual of a closure; odometry always has the squared loss."""

    SQUARED = "squared"
    CAUCHY = "cauchy"

    def values(self, chi2: FloatArray) -> FloatArray:
        """``rho`` of squared Mahalanobis lengths ``chi2``, shape (K,)."""
        return CAUCHY_WIDTH**2 * np.log1p(chi2 / CAUCHY_WIDTH**2) if self is Loss.CAUCHY else chi2

    def weights(self, chi2: FloatArray) -> FloatArray:
        """``rho'`` in [0, 1], shape (K,), of squared Mahalanobis lengths ``chi2``, shape (K,)."""
        if self is Loss.CAUCHY:
            return CAUCHY_WIDTH**2 / (CAUCHY_WIDTH**2 + chi2)
        return np.ones_like(chi2)


def minimize(
    group: Group,
    edges: EdgeArrays,
    poses: FloatArray,
    held: NDArray[np.bool_],
    *,
    loss: Loss = Loss.SQUARED,
    iterations: int = 100,
    tolerance: float = TOLERANCE,
) -> tuple[FloatArray, int, float]:
    """Find the poses of least cost from the ``poses`` (N, ...) on; those that are ``held``, shape (N,), stay.

    Returns the poses, the number of steps, and the cost.
    """

    def evaluate(poses: FloatArray) -> tuple[FloatArray, FloatArray, float]:
        residual = group.residual(edges.T_i_j, poses[edges.i], poses[edges.j])
        chi2 = np.einsum("ea,eab,eb->e", residual, edges.information, residual)
        return residual, chi2, 0.5 * float(np.where(edges.robust, loss.values(chi2), chi2).sum())

    structure, damping = find_structure(edges.i, edges.j, len(poses)), _DAMPING
    residual, chi2, cost = evaluate(poses)
    for taken in range(iterations):
        weights = np.where(edges.robust, loss.weights(chi2), 1.0)
        information = weights[:, None, None] * edges.information
        jacobians = group.jacobians(residual, poses[edges.i], poses[edges.j])
        while True:
            step, gradient = solve(structure, jacobians, information, residual, held, damping)
            moved = group.retract(poses, step)
            after = evaluate(moved)
            gain, promised = cost - after[2], 0.5 * float((step * (damping * step - gradient)).sum())
            if gain > _LEAST_GAIN * promised > 0.0:
                break
            if abs(gain) <= tolerance * cost:
                return poses, taken, cost
            damping *= _DAMPING_STEP
            if damping * _DAMPING > 1.0:
                return poses, taken, cost
        damping /= _DAMPING_STEP
        poses, (residual, chi2, cost) = moved, after
        if gain <= tolerance or gain <= tolerance * (cost + gain):
            return poses, taken + 1, cost
    return poses, iterations, cost
