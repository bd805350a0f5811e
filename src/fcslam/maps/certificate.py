"""How good a map is where: the expected error of each square metre, by the marginal covariances of the pose graph.

Two errors count for a cell: that of its position in the frame of the map's first robot, and that of its position
relative to its surroundings. The covariances of the graph are larger than the errors, because no measurement counts as
more precise than scan matching at its worst. ``SCALE`` is calibrated on simulated buildings
(``benchmarks/certificate.py``). Where measurements contradict each other more than with a good scanner, the
errors are larger: ``CONTRADICTED``.
"""

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Any, Final, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from fcslam.geometry import se2
from fcslam.geometry.groups import SE2
from fcslam.graph.cholesky import find_structure, marginal_covariance
from fcslam.graph.pose_graph import Edge, PoseGraph
from fcslam.lidar.verification import CLOSURE_SIGMA_M
from fcslam.maps.occupancy_map import Occupancy, OccupancyMap, pixels_of
from fcslam.records import FloatArray
from fcslam.runs import QUALITY

SCALE: Final = 0.25
"""Ratio of true errors to the standard deviations of the graph."""
CONTRADICTED: Final = 10.0 * SCALE
"""Ratio of true errors to the standard deviations of the graph, by the root mean square of what the edges of the graph
leave as residuals: 1 if the measurements scatter as the graph expects."""
FLOOR_M: Final = 0.008
"""Error that every cell has: noise of the ranges and of matching, metres."""
QUANTILE: Final = 2.0
"""Ratio of the error that 95 % of cells stay below to its root mean square; of a normal error in the plane, 1.73."""
BAR_M: Final = 0.05
WITHIN_M: Final = 10.0
CELL_M: Final = 1.0
MOST_PLACES: Final = 600
"""Places whose covariances are computed; of a larger map they lie farther apart."""
SEEN_FROM_M: Final = 0.5 * WITHIN_M
"""A pass counts for the cells up to this distance."""
PASS_GAP_S: Final = 20.0
"""Two scans of one robot with a longer gap between them are two passes."""
OPEN_M: Final = CLOSURE_SIGMA_M
"""A motion is open if its weakest direction has a larger standard deviation."""
OPEN_LENGTH_M: Final = 3.0 * CELL_M
"""Shorter open stretches are not named."""
AGAIN_M: Final = 0.01
AGAIN_PER_M: Final = 0.1 * AGAIN_M
"""Standard deviation of the motion that another drive between two places measures: constant, and by metre."""
UNKNOWN_INFORMATION: Final = 1e-4
"""Information about the pose of keyscans that no edge connects with the first one."""
_S: Final = np.array(((0.0, -1.0), (1.0, 0.0)))


class MappedPath(NamedTuple):
    """The keyscans of one session."""

    session: str
    stamps: FloatArray
    """Shape (N,), seconds."""
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
    """Covariance of the errors (x, y, theta) along the axes of ``map``, (3 P, 3 P), calibrated, without the floor."""
    scale: float
    """Ratio of errors to the standard deviations of the graph."""

    def absolute_m(self) -> FloatArray:
        """Expected error of each place in the frame of the map, root mean square, shape (P,)."""
        variance = np.diag(self.covariance).reshape(-1, 3)
        return np.sqrt(variance[:, 0] + variance[:, 1] + FLOOR_M**2)

    def relative_m(self, within_m: float) -> FloatArray:
        """Expected error of the places within a distance as seen from each place, root mean square, shape (P,)."""
        return relative_error(self.poses, self.covariance, within_m)


def certify(
    graph: PoseGraph,
    paths: Sequence[MappedPath],
    occupancy: OccupancyMap,
    bar_m: float = BAR_M,
    within_m: float = WITHIN_M,
) -> dict[str, Any]:
    """The certificate of one map, as ``quality.json`` has it; lengths in metres.

    ``paths`` are the sessions of the map, at least one keyscan in all; the first one begins its frame. A cell is good
    if 95 % of such cells have a smaller error than ``bar_m`` relative to their surroundings, within ``within_m``.
    """
    places = covariances(graph, paths)
    absolute, relative = places.absolute_m(), places.relative_m(within_m)
    local = places.relative_m(SEEN_FROM_M)
    centres = _known_squares(occupancy)
    nearest = np.array([np.argmin(_distances(places.poses, centre)) for centre in centres], np.int64)
    turn = np.sqrt(np.diag(places.covariance)[2::3])
    lever = np.hypot(*(centres - places.poses[nearest, :2]).T) * turn[nearest]
    passes, seen_s = _passes(centres, paths)
    bound = QUANTILE * relative
    is_good = bound <= bar_m
    cells = [
        {
            "x": round(float(x), 3),
            "y": round(float(y), 3),
            "error": round(float(math.hypot(absolute[k], along)), 4),
            "neighbours": round(float(local[k]), 4),
            "bound_95": round(float(bound[k]), 4),
            "good": bool(is_good[k]),
            "passes": int(count),
            "last_seen": round(float(seen), 3) if count else None,
        }
        for (x, y), k, along, count, seen in zip(centres, nearest, lever, passes, seen_s, strict=True)
    ]
    good = [cell for cell in cells if cell["good"]]
    return {
        "bar": bar_m,
        "within": within_m,
        "cell": CELL_M,
        "scale": round(places.scale, 4),
        "floor": FLOOR_M,
        "error_95": round(float(np.percentile(bound[nearest], 95)), 4) if cells else None,
        "good_share": round(len(good) / len(cells), 4) if cells else None,
        "verdict": f"{len(good)} of {len(cells)} m2 are good to {bar_m:g} m within {within_m:g} m",
        "open_stretches": _open_stretches(graph, paths),
        "drives": _drives(places, nearest, is_good, bar_m, within_m),
        "cells": cells,
    }


def covariances(graph: PoseGraph, paths: Sequence[MappedPath]) -> Places:
    """A sample of the keyscans of one map with the covariance of their errors; the first keyscan has none."""
    poses = np.concatenate([path.T_map_base for path in paths])
    variables = np.concatenate([path.variables for path in paths])
    rows = np.full(len(graph), -1)
    rows[variables] = np.arange(len(variables))
    part, chosen = _part(graph, poses, rows).arrays(), _sampled(poses)
    held, no_residual = np.arange(len(poses)) == 0, np.zeros((len(part.i), 3))
    jacobians = SE2.jacobians(no_residual, poses[part.i], poses[part.j])
    structure = find_structure(part.i, part.j, len(poses))
    in_bases = marginal_covariance(structure, jacobians, part.information, held, chosen).reshape(len(chosen), 3, -1, 3)
    turn = se2.adjoint(poses[chosen] * (0.0, 0.0, 1.0))
    covariance = np.einsum("pab,pbqc,qdc->paqd", turn, in_bases, turn, optimize=True).reshape(3 * len(chosen), -1)
    scale = max(SCALE, CONTRADICTED * _contradiction(graph, rows, len(variables)))
    return Places(variables[chosen], poses[chosen], covariance * scale**2, scale)


def _contradiction(graph: PoseGraph, rows: NDArray[np.int64], variables: int) -> float:
    """Root mean square residual of the edges of one map, in standard deviations, for each redundant measurement."""
    edges = graph.arrays()
    inside = np.flatnonzero((rows[edges.i] >= 0) & (rows[edges.j] >= 0))
    redundant = len(inside) - (variables - 1)
    return math.sqrt(float(graph.chi2(rows=inside).sum()) / (3.0 * redundant)) if redundant > 0 else 0.0


def relative_error(
    poses: FloatArray, covariance: FloatArray, within_m: float, wanted: NDArray[np.int64] | None = None
) -> FloatArray:
    """Root mean square error of the positions within a distance of each place as seen from it, shape (P,), metres.

    Of a place without any so near, that of the nearest one. Places that are not ``wanted`` have the smallest error.
    """
    result = np.full(len(poses), FLOOR_M)
    if len(poses) < 2:
        return result
    rows = np.arange(len(poses)) if wanted is None else wanted
    blocks = covariance.reshape(len(poses), 3, len(poses), 3).transpose(0, 2, 1, 3)
    own, cross = blocks[rows, rows][:, None], blocks[:, rows].swapaxes(0, 1)
    apart = poses[:, :2] - poses[rows, None, :2]
    swing = apart @ _S.T  # change of the other's position by a turn of this place
    position = np.einsum("kkii->k", blocks[..., :2, :2])
    variance = position + position[rows, None] - 2.0 * (cross[..., 0, 0] + cross[..., 1, 1])
    turns = cross[..., :2, 2] - own[..., :2, 2]
    variance += own[..., 2, 2] * (swing**2).sum(axis=2) - 2.0 * (swing * turns).sum(axis=2)
    away_m = np.hypot(apart[..., 0], apart[..., 1])
    away_m[np.arange(len(rows)), rows] = np.inf
    near = away_m <= np.maximum(within_m, away_m.min(axis=1, keepdims=True))
    result[rows] = np.sqrt(np.maximum((variance * near).sum(axis=1) / near.sum(axis=1), 0.0) + FLOOR_M**2)
    return result


def certificate_json(certificates: Mapping[int, Mapping[str, Any]]) -> bytes:
    """The content of ``quality.json``: the certificate of each map, by its number."""
    return (
        json.dumps({str(k): one for k, one in certificates.items()}, separators=(",", ":"), allow_nan=False) + "\n"
    ).encode()


def certificate_png(certificate: Mapping[str, Any], occupancy: OccupancyMap) -> bytes:
    """The map, green where it is good and red where its error is twice the bar."""
    picture = cv2.cvtColor(pixels_of(occupancy.cells), cv2.COLOR_GRAY2BGR)
    side = round(certificate["cell"] / occupancy.resolution_m)
    for cell in certificate["cells"]:
        bad = min(max(cell["bound_95"] / certificate["bar"] - 0.5, 0.0) / 1.5, 1.0)
        column, row = (
            round((cell[axis] - origin - certificate["cell"] / 2.0) / occupancy.resolution_m)
            for axis, origin in zip("xy", occupancy.origin_xy, strict=True)
        )
        part = picture[max(row, 0) : row + side, max(column, 0) : column + side]
        free = occupancy.cells[max(row, 0) : row + side, max(column, 0) : column + side] == Occupancy.FREE
        part[free] = (0.5 * part[free] + 0.5 * np.array((60.0, 220.0 * (1.0 - bad), 220.0 * bad))).astype(np.uint8)
    return bytes(cv2.imencode(".png", picture[::-1])[1])


def quality_files(certificates: Mapping[int, Mapping[str, Any]], maps: Mapping[int, OccupancyMap]) -> dict[str, bytes]:
    """``quality.json``, and a picture of each map that has a certificate."""
    pictures = {
        f"{QUALITY}_{k}.png" if k else f"{QUALITY}.png": certificate_png(one, maps[k])
        for k, one in certificates.items()
    }
    return {f"{QUALITY}.json": certificate_json(certificates), **pictures}


def _part(graph: PoseGraph, poses: FloatArray, rows: NDArray[np.int64]) -> PoseGraph:
    """One map. What no edge connects with the first keyscan is held by it weakly, so that it counts as unknown."""
    edges = graph.arrays()
    edges = edges.select((rows[edges.i] >= 0) & (rows[edges.j] >= 0))
    part = PoseGraph.restored(poses, replace(edges, i=rows[edges.i], j=rows[edges.j]))
    for begin in np.flatnonzero(part.components() == np.arange(len(poses)))[1:].tolist():
        part.add_edge(Edge(0, begin, se2.between(poses[0], poses[begin]), UNKNOWN_INFORMATION * np.eye(3), True))
    return part


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


def _passes(centres: FloatArray, paths: Sequence[MappedPath]) -> tuple[NDArray[np.int64], FloatArray]:
    """How often robots passed each square, and the stamp of the last keyscan near it; NaN if none was."""
    count, newest = np.zeros(len(centres), np.int64), np.full(len(centres), np.nan)
    for path in paths:
        for k, centre in enumerate(centres):
            stamps = np.sort(path.stamps[_distances(path.T_map_base, centre) <= SEEN_FROM_M])
            if len(stamps):
                count[k] += 1 + int((np.diff(stamps) > PASS_GAP_S).sum())
                newest[k] = np.nanmax((newest[k], stamps[-1]))
    return count, newest


def _distances(poses: FloatArray, place: FloatArray) -> FloatArray:
    """Distance of each pose (N, 3) from a place, shape (2,) or (3,), metres, shape (N,)."""
    return np.asarray(np.hypot(poses[:, 0] - place[0], poses[:, 1] - place[1]))


def _open_stretches(graph: PoseGraph, paths: Sequence[MappedPath]) -> list[dict[str, Any]]:
    """Stretches along which the scans did not fix the motion in every direction, and no closure ends in them."""
    edges = graph.arrays()
    weakest = 1.0 / np.sqrt(np.maximum(np.linalg.eigvalsh(edges.information)[:, 0], 1e-12))
    motion = {(int(i), int(j)): float(sigma) for i, j, sigma in zip(edges.i, edges.j, weakest, strict=True)}
    chain = {
        pair for path in paths for pair in zip(path.variables[:-1].tolist(), path.variables[1:].tolist(), strict=True)
    }
    closed = {end for pair in motion if pair not in chain for end in pair}
    found = []
    for path in paths:
        variables, begin = path.variables.tolist(), 0
        is_open = [motion.get(pair, 0.0) > OPEN_M and pair[1] not in closed for pair in pairwise(variables)]
        for k, now in enumerate([*is_open, False]):
            if now:
                continue
            steps = np.diff(path.T_map_base[begin : k + 1, :2], axis=0)
            length_m = float(np.hypot(*steps.T).sum()) if len(steps) else 0.0
            if length_m >= OPEN_LENGTH_M:
                ends = [[round(float(value), 2) for value in path.T_map_base[end, :2]] for end in (begin, k)]
                found.append(
                    {
                        "robot": path.session,
                        "from": ends[0],
                        "to": ends[1],
                        "length": round(length_m, 2),
                        "first": float(path.stamps[begin]),
                        "last": float(path.stamps[k]),
                    }
                )
            begin = k + 1
    return found


def _drives(
    places: Places, nearest: NDArray[np.int64], is_good: NDArray[np.bool_], bar_m: float, within_m: float
) -> list[dict[str, Any]]:
    """What to drive again, the drive with the largest gain first; none if nothing helps."""
    weight = np.bincount(nearest, minlength=len(places.poses))
    bad = np.flatnonzero(~is_good & (weight > 0))
    known = np.flatnonzero(is_good) if is_good.any() else np.array([0])
    found: list[dict[str, Any]] = []
    error = places.relative_m(within_m)
    for b in bad[np.argsort(-error[bad])][:: max(1, len(bad) // 8)].tolist()[:8]:
        apart = np.hypot(*(places.poses[known, :2] - places.poses[b, :2]).T)
        a = int(known[np.argmin(np.where(known == b, np.inf, apart))])
        if a == b:
            continue
        length_m = float(np.hypot(*(places.poses[a, :2] - places.poses[b, :2])))
        updated = _with_motion(places, a, b, AGAIN_M + AGAIN_PER_M * length_m)
        after = relative_error(places.poses, updated, within_m, bad)
        gain = int(weight[bad[QUANTILE * after[bad] <= bar_m]].sum())
        if gain:
            ends = [[round(float(value), 1) for value in places.poses[k, :2]] for k in (a, b)]
            found.append(
                {
                    "from": ends[0],
                    "to": ends[1],
                    "gain_m2": gain,
                    "text": f"drive from ({ends[0][0]}, {ends[0][1]}) to ({ends[1][0]}, {ends[1][1]}) again: "
                    f"about {gain} m2 more are good then",
                }
            )
    return sorted(found, key=lambda drive: -int(drive["gain_m2"]))[:3]


def _with_motion(places: Places, a: int, b: int, sigma_m: float) -> FloatArray:
    """The covariance after the motion between two places was measured once more."""
    jacobian = np.zeros((3, 3 * len(places.poses)))
    jacobian[:, 3 * b : 3 * b + 3] = np.eye(3)
    jacobian[:, 3 * a : 3 * a + 3] = -np.eye(3)
    jacobian[:2, 3 * a + 2] = -_S @ (places.poses[b, :2] - places.poses[a, :2])
    measured = np.diag((sigma_m**2, sigma_m**2, (sigma_m / 5.0) ** 2))
    gained = places.covariance @ jacobian.T
    updated: FloatArray = places.covariance - gained @ np.linalg.solve(jacobian @ gained + measured, gained.T)
    return updated
