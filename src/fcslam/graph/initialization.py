"""Initial poses of a graph without a good estimate, by chordal relaxation: two sparse linear systems.

Rotations as complex numbers of any length minimise ``sum k |u_j - u_i e^(i theta_ij)|^2``; translations follow with
the rotations held (Carlone et al., ICRA 2015, in the plane).
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fcslam.geometry import se2
from fcslam.graph.cholesky import Structure, find_structure, solve
from fcslam.graph.pose_graph import PoseGraph
from fcslam.records import FloatArray

_INFORMATION_RATIO = 1e4
"""Largest ratio of an edge's information to the median, and its inverse: the linear systems stay well conditioned."""

_WEIGHT_EXPONENT = -0.9
"""Exponent of chi-square in the weight of a closure."""

_MOST_REWEIGHTINGS = 20
_WEIGHT_TOLERANCE = 1e-3
"""Largest change of a weight at which reweighting ends."""

_Complex = NDArray[np.complex128]


def initialize(graph: PoseGraph, weights: ArrayLike | None = None) -> FloatArray:
    """Poses (N, 3) near the optimum of the graph without any initial estimate.

    Each connected component keeps the initial pose of its first variable. ``weights`` (E,) in [0, 1] scale the edges'
    information; an edge of weight 0 is left out (``~graph.arrays().robust`` leaves odometry alone). None: all are 1.
    """
    edges = graph.arrays()
    scale = np.ones(len(edges.i)) if weights is None else np.asarray(weights, dtype=np.float64)
    kept = scale > 0.0
    start = graph.poses()
    if not kept.any():
        return start
    i, j, T_i_j, scale = edges.i[kept], edges.j[kept], edges.T_i_j[kept], scale[kept]
    structure, held = find_structure(i, j, len(graph)), graph.components(kept) == np.arange(len(graph))
    information = edges.information[kept]
    k_heading = np.sqrt(scale * _clip_to_median(information[:, 2, 2]))
    k_position = np.sqrt(scale * _clip_to_median(0.5 * (information[:, 0, 0] + information[:, 1, 1])))

    turn = np.exp(1j * T_i_j[:, 2])
    heading = np.angle(_least_squares(structure, k_heading, turn, 0.0 * turn, held, held * np.exp(1j * start[:, 2])))
    step = np.exp(1j * heading[i]) * (T_i_j[:, 0] + 1j * T_i_j[:, 1])
    origin = held * (start[:, 0] + 1j * start[:, 1])
    position = _least_squares(structure, k_position, np.ones_like(turn), step, held, origin)
    poses = np.stack((position.real, position.imag, se2.wrap_angle(heading)), axis=-1)
    poses[held] = start[held]
    return poses


def initialize_robust(graph: PoseGraph) -> FloatArray:
    """Compute poses (N, 3) as ``initialize``, with closures reweighted until false ones hardly count.

    Iteratively reweighted least squares with weight ``d^-1.8`` at a residual of d > 1 standard deviations. After large
    drift, ``fcslam.graph.optimizer.optimize_gnc`` converges from here and not from odometry. We tried the INTEL graph
    of 1,228 poses with as many random false closures as true ones. From here it keeps every true closure and rejects
    every false one; from odometry it loses two thirds of the true ones.
    """
    robust = graph.arrays().robust
    weights = np.ones(len(robust))
    poses = initialize(graph, weights)
    for _ in range(_MOST_REWEIGHTINGS):
        reweighted = np.where(robust, np.maximum(graph.chi2(poses), 1.0) ** _WEIGHT_EXPONENT, 1.0)
        if np.abs(reweighted - weights).max(initial=0.0) < _WEIGHT_TOLERANCE:
            break
        weights = reweighted
        poses = initialize(graph, weights)
    return poses


def _clip_to_median(information: FloatArray) -> FloatArray:
    middle = np.median(information)
    return np.clip(information, middle / _INFORMATION_RATIO, middle * _INFORMATION_RATIO)


def _least_squares(
    structure: Structure, k: FloatArray, turn: _Complex, step: _Complex, held: NDArray[np.bool_], z: _Complex
) -> _Complex:
    """The z (N,) with least ``sum |k (z_j - turn z_i - step)|^2``, from a z whose ``held`` numbers stay."""
    i, j, *_ = structure
    of_j = k[:, None, None] * np.eye(2)
    rotation = np.stack((turn.real, -turn.imag, turn.imag, turn.real), axis=-1).reshape(-1, 2, 2)
    residual = (k * (z[j] - turn * z[i] - step)).view(float).reshape(-1, 2)
    unit = np.tile(np.eye(2), (len(k), 1, 1))
    change, _ = solve(structure, (-of_j @ rotation, of_j), unit, residual, held)
    solution: _Complex = z + change.view(complex)[:, 0]
    return solution
