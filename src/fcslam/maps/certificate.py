"""How good a map is where: how far the map around each square metre is bent, by the marginal covariances of the graph.

The error of a place is the root mean square distance of the places around it from the truth, after the best rigid
alignment of both: distances on the map within the surroundings are that wrong. The covariances of the graph give its
expectation, but not its size, because no measurement counts as more precise than scan matching at its worst. What the
measurements leave as residuals gives the size. Wheels that slip where the scans do not see it leave none, so there the
size grows with what rests on the wheels alone. ``QUANTILE`` was chosen on maps of published floors.
``benchmarks/certificate.py`` measures how often the bound holds, and the conformal quantile without each building.
"""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fcslam.geometry import se2
from fcslam.geometry.groups import SE2
from fcslam.graph.cholesky import find_structure, marginal_covariance
from fcslam.graph.pose_graph import Edge, EdgeArrays, PoseGraph
from fcslam.lidar.evidence import SIGMA_PER_TURN
from fcslam.lidar.frontend import ODOMETRY_SIGMA_M
from fcslam.lidar.odometry import PREDICTED
from fcslam.maps.frontiers import frontiers
from fcslam.maps.occupancy_map import OccupancyMap
from fcslam.records import FloatArray

QUIET: Final = 0.1
"""Ratio of true errors to the standard deviations of the graph where its edges leave no residuals. Their root mean
square, 1 if the measurements scatter as the graph expects, is added in quadrature."""
UNSEEN: Final = 0.5
"""The same ratio where scans see nothing of a motion, so that slips of the wheels leave no residuals."""
QUANTILE: Final = 3.6
"""Ratio of the error that 95 % of the cells of a map stay below to the expected one, in most maps."""
WITHIN_M: Final = 10.0
CELL_M: Final = 1.0
MOST_PLACES: Final = 600
"""Places whose covariances are computed; of a larger map they lie farther apart."""
FEWEST_NEAR: Final = 5
"""Places around a place, at least; farther ones count if there are fewer."""
FEWEST_REDUNDANT: Final = 10
"""Redundant measurements by which residuals are divided, at least: few do not show how measurements scatter."""
LEAST_GAIN_M2: Final = 10
"""Area that another drive makes good, or that is unknown beyond an open edge of the map, at least."""
UNKNOWN_INFORMATION: Final = 1e-4
"""Information about the pose of keyscans that no edge connects with the first one, and about a step along which neither
wheels nor scans see."""
_S: Final = np.array(((0.0, -1.0), (1.0, 0.0)))


class MappedPath(NamedTuple):
    """The keyscans of one session."""

    T_map_base: FloatArray
    """Shape (N, 3)."""
    variables: NDArray[np.int64]
    """Variable of each keyscan in the graph, shape (N,)."""


class Places(NamedTuple):
    """A sample of the keyscans of one map."""

    variables: NDArray[np.int64]
    """Shape (P,)."""
    poses: FloatArray
    """Shape (P, 3)."""
    covariance: FloatArray
    """Covariance of the errors (x, y, theta) along the axes of ``map``, by the graph, (3 P, 3 P)."""
    scale: FloatArray
    """Ratio of errors to the standard deviations of the graph, around each place, (P,)."""
    drift: FloatArray
    """Covariance that a drive of one metre adds near each place, by the graph, along the axes of ``map``, (P, 3, 3)."""

    def bend_m(self, within_m: float, wanted: NDArray[np.int64] | None = None) -> FloatArray:
        """Root mean square error of the positions around each place after the best rigid alignment, shape (P,).

        Places that are not ``wanted`` have none; None: all are.
        """
        poses, result = self.poses, np.zeros(len(self.poses))
        if len(poses) < 3:
            return result
        farthest = min(FEWEST_NEAR, len(poses)) - 1
        for k in range(len(poses)) if wanted is None else wanted.tolist():
            apart_m = _distances(poses, poses[k])
            near = np.flatnonzero(apart_m <= max(within_m, float(np.partition(apart_m, farthest)[farthest])))
            arms = poses[near, :2] - poses[near, :2].mean(axis=0)
            motions = np.concatenate((np.tile(np.eye(2), (len(near), 1)), (arms @ _S.T).reshape(-1, 1)), axis=1)
            motions /= np.maximum(np.linalg.norm(motions, axis=0), 1e-9)
            rows = (3 * near[:, None] + (0, 1)).ravel()
            around = self.covariance[np.ix_(rows, rows)]
            rigid = (motions * (around @ motions)).sum()
            result[k] = math.sqrt(max(0.0, float(np.trace(around) - rigid)) / len(near))
        return self.scale * result


def certify(
    graph: PoseGraph,
    paths: Sequence[MappedPath],
    occupancy: OccupancyMap,
    bar_m: float | None = None,
    robot_radius_m: float = 0.0,
    measured: PoseGraph | None = None,
) -> dict[str, Any]:
    """The certificate of one map, as ``quality.json`` has it; lengths in metres.

    ``paths`` are the sessions of the map, at least one keyscan in all; the first one begins its frame. A cell is good
    if the bound of the error within ``WITHIN_M`` around it is at most ``bar_m``, by default a cell of the map.
    ``measured`` has the residuals of the measurements: the graph before a plan or surveyed tags bent it, or in space.
    """
    bar_m = occupancy.resolution_m if bar_m is None else bar_m
    places = covariances(graph, paths, measured)
    centres = _known_squares(occupancy)
    nearest = np.array([np.argmin(_distances(places.poses, centre)) for centre in centres], np.int64)
    bound = np.minimum(QUANTILE * places.bend_m(WITHIN_M), WITHIN_M)
    is_good = bound <= bar_m
    cells = [
        {"x": round(x, 3), "y": round(y, 3), "bound_95": round(float(bound[k]), 4), "good": bool(is_good[k])}
        for (x, y), k in zip(centres.tolist(), nearest, strict=True)
    ]
    ends = np.array([path.T_map_base[-1, :2] for path in paths if len(path.T_map_base)])
    return {
        "bar": bar_m,
        "within": WITHIN_M,
        "cell": CELL_M,
        "error_95": round(float(np.percentile(bound[nearest], 95)), 4) if cells else None,
        "good_share": round(float(is_good[nearest].mean()), 4) if cells else None,
        "drives": _drives(places, nearest, is_good, bar_m),
        "open_ends": [
            {"x": round(one.point[0], 2), "y": round(one.point[1], 2), "gain_m2": round(one.gain_m2, 1)}
            for one in frontiers(occupancy, ends, robot_radius_m, with_paths=False)
            if one.gain_m2 >= LEAST_GAIN_M2
        ],
        "cells": cells,
    }


def covariances(graph: PoseGraph, paths: Sequence[MappedPath], measured: PoseGraph | None = None) -> Places:
    """A sample of the keyscans of one map with the covariance of their errors; the first keyscan has none."""
    poses = np.concatenate([path.T_map_base for path in paths])
    variables = np.concatenate([path.variables for path in paths])
    rows = np.full(len(graph), -1)
    rows[variables] = np.arange(len(variables))
    part, chosen = _unseen_steps_open(_part(graph, poses, rows).arrays()), _sampled(poses)
    held, no_residual = np.arange(len(poses)) == 0, np.zeros((len(part.i), 3))
    jacobians = SE2.jacobians(no_residual, poses[part.i], poses[part.j])
    structure = find_structure(part.i, part.j, len(poses))
    in_bases = marginal_covariance(structure, jacobians, part.information, held, chosen).reshape(len(chosen), 3, -1, 3)
    turn = se2.adjoint(poses[chosen] * (0.0, 0.0, 1.0))
    covariance = np.einsum("pab,pbqc,qdc->paqd", turn, in_bases, turn, optimize=True).reshape(3 * len(chosen), -1)
    drift, unseen = _path_near(part, poses, chosen)
    contradiction = _contradiction(measured or graph, rows, poses, chosen)
    scale = np.sqrt(QUIET**2 + contradiction**2 + (UNSEEN * unseen) ** 2)
    return Places(variables[chosen], poses[chosen], covariance, scale, drift)


def _path_near(edges: EdgeArrays, poses: FloatArray, chosen: NDArray[np.int64]) -> tuple[FloatArray, FloatArray]:
    """For the path around the chosen poses: what a metre adds, and what the scans do not see of it.

    The covariance that a metre adds along the axes of ``map``, shape (P, 3, 3); and the square of the largest variance
    of a step's position in that of the wheels alone, 1 at most, shape (P,). Both are means over the steps within
    ``WITHIN_M``, or those of the nearest step.
    """
    steps = np.flatnonzero((edges.j == edges.i + 1) & (np.hypot(*edges.T_i_j[:, :2].T) > 1e-3))
    if not len(steps):
        return np.zeros((len(chosen), 3, 3)), np.zeros(len(chosen))
    turn = se2.adjoint(poses[edges.j[steps]] * (0.0, 0.0, 1.0))
    length_m = np.hypot(*edges.T_i_j[steps, :2].T)
    covariance = np.linalg.inv(edges.information[steps])
    added = turn @ covariance @ turn.swapaxes(1, 2) / length_m[:, None, None]
    share = np.linalg.eigvalsh(covariance[:, :2, :2])[:, 1] / (ODOMETRY_SIGMA_M + SIGMA_PER_TURN * length_m) ** 2
    apart_m = np.array([_distances(poses[edges.j[steps]], place) for place in poses[chosen]])
    near = apart_m <= np.maximum(WITHIN_M, apart_m.min(axis=1, keepdims=True))
    values = np.column_stack((added.reshape(-1, 9), np.minimum(share, 1.0) ** 2))
    means = near @ values / near.sum(axis=1, keepdims=True)
    return means[:, :9].reshape(-1, 3, 3), means[:, 9]


def _contradiction(
    graph: PoseGraph, rows: NDArray[np.int64], poses: FloatArray, chosen: NDArray[np.int64]
) -> FloatArray:
    """Root mean square residual of the edges around the chosen poses, in standard deviations, shape (P,).

    It is for each redundant measurement of one map within ``WITHIN_M``.
    """
    edges = graph.arrays()
    inside = np.flatnonzero((rows[edges.i] >= 0) & (rows[edges.j] >= 0))
    near = np.array([_distances(poses, place) <= WITHIN_M for place in poses[chosen]])
    of_edges = near[:, rows[edges.i[inside]]]
    redundant = np.maximum(of_edges.sum(axis=1) - near.sum(axis=1), FEWEST_REDUNDANT)
    return np.asarray(np.sqrt(of_edges @ graph.chi2(rows=inside) / (graph.group.freedom * redundant)))


def _part(graph: PoseGraph, poses: FloatArray, rows: NDArray[np.int64]) -> PoseGraph:
    """One map. What no edge connects with the first keyscan is held by it weakly, so that it counts as unknown."""
    edges = graph.arrays()
    edges = edges.select((rows[edges.i] >= 0) & (rows[edges.j] >= 0))
    part = PoseGraph.restored(poses, replace(edges, i=rows[edges.i], j=rows[edges.j]))
    for begin in np.flatnonzero(part.components() == np.arange(len(poses)))[1:].tolist():
        part.add_edge(Edge(0, begin, se2.between(poses[0], poses[begin]), UNKNOWN_INFORMATION * np.eye(3), True))
    return part


def _unseen_steps_open(edges: EdgeArrays) -> EdgeArrays:
    """The edges, with next to no information about the length of steps that the scans do not see without wheels.

    The points say less of such a step than its prediction, by the motion before it. The prediction errs by the same
    velocity from step to step, so the errors add up to the whole length, and no standard deviation bounds them.
    """
    covariance = np.linalg.inv(edges.information)
    variance, axes = np.linalg.eigh(covariance[:, :2, :2])
    length_m = np.hypot(*edges.T_i_j[:, :2].T)
    predicted_m = PREDICTED.position_m + PREDICTED.position_per_travel * length_m
    predicted_m += PREDICTED.position_per_turn_m * np.abs(edges.T_i_j[:, 2])
    unseen = (edges.j == edges.i + 1) & (variance[:, 1] > 0.5 * predicted_m**2)
    along = axes[unseen, :, 1]
    covariance[unseen, :2, :2] += along[:, :, None] * along[:, None] / UNKNOWN_INFORMATION
    return replace(edges, information=np.linalg.inv(covariance))


def _sampled(poses: FloatArray) -> NDArray[np.int64]:
    spacing_m = CELL_M
    while True:
        squares = np.floor(poses[:, :2] / spacing_m).astype(np.int64)
        chosen = np.sort(np.unique(squares, axis=0, return_index=True)[1])
        if len(chosen) <= MOST_PLACES:
            return chosen
        spacing_m *= 1.5


def _known_squares(occupancy: OccupancyMap) -> FloatArray:
    rows, columns = np.nonzero(occupancy.cells)
    x, y = (
        np.floor((origin + occupancy.resolution_m * (cells + 0.5)) / CELL_M).astype(np.int64)
        for origin, cells in zip(occupancy.origin_xy, map(np.arange, occupancy.cells.shape[::-1]), strict=True)
    )
    is_known = np.zeros((x[-1] - x[0] + 1, y[-1] - y[0] + 1), np.bool_)
    is_known[x[columns] - x[0], y[rows] - y[0]] = True
    centres: FloatArray = (np.argwhere(is_known) + (x[0], y[0]) + 0.5) * CELL_M
    return centres


def _distances(poses: FloatArray, place: FloatArray) -> FloatArray:
    """Distance of each pose (N, 3) from a place, shape (2,) or (3,), metres, shape (N,)."""
    return np.asarray(np.hypot(poses[:, 0] - place[0], poses[:, 1] - place[1]))


def _drives(
    places: Places, nearest: NDArray[np.int64], is_good: NDArray[np.bool_], bar_m: float
) -> list[dict[str, Any]]:
    """What to drive again, the drive with the largest gain first; none if nothing helps."""
    weight = np.bincount(nearest, minlength=len(places.poses))
    bad = np.flatnonzero(~is_good & (weight > 0))
    known = np.flatnonzero(is_good) if is_good.any() else np.array([0])
    found: list[dict[str, Any]] = []
    error = places.bend_m(WITHIN_M, bad)
    for b in bad[np.argsort(-error[bad])][:: max(1, len(bad) // 8)].tolist()[:8]:
        apart = np.hypot(*(places.poses[known, :2] - places.poses[b, :2]).T)
        a = int(known[np.argmin(np.where(known == b, np.inf, apart))])
        if a == b:
            continue
        after = places._replace(covariance=_with_motion(places, a, b)).bend_m(WITHIN_M, bad)
        gain = int(weight[bad[QUANTILE * after[bad] <= bar_m]].sum())
        if gain >= LEAST_GAIN_M2:
            ends = [[round(float(value), 1) for value in places.poses[k, :2]] for k in (a, b)]
            found.append({"from": ends[0], "to": ends[1], "gain_m2": gain})
    return sorted(found, key=lambda drive: -int(drive["gain_m2"]))[:3]


def _with_motion(places: Places, a: int, b: int) -> FloatArray:
    """The covariance after the motion between two places was measured once more, as well as the path nearby."""
    jacobian = np.zeros((3, 3 * len(places.poses)))
    jacobian[:, 3 * b : 3 * b + 3] = np.eye(3)
    jacobian[:, 3 * a : 3 * a + 3] = -np.eye(3)
    apart = places.poses[b, :2] - places.poses[a, :2]
    jacobian[:2, 3 * a + 2] = -_S @ apart
    measured = float(np.hypot(*apart)) * places.drift[b] + 1e-12 * np.eye(3)
    gained = places.covariance @ jacobian.T
    updated: FloatArray = places.covariance - gained @ np.linalg.solve(jacobian @ gained + measured, gained.T)
    return updated
