"""Drives along the ways of a yard: tours that come back to where they began."""

import numpy as np
from scipy.ndimage import gaussian_filter1d
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra

from fcslam.lab.simulation.floorplan import FloorPlan
from fcslam.records import FloatArray, frozen

_STEP_M = 0.25
"""Distance of waypoints."""
_CORNER_M = 1.2
"""Corners are rounded over about this distance to each side."""
_SWAY_M, _SWAY_LENGTH_M = 0.35, 8.0
"""Standard deviation of the distance from the middle of the way, and how fast it changes."""
_SWAY_LIMIT_M = 0.8


def draw_starts(plan: FloorPlan, robots: int, rng: np.random.Generator) -> list[FloatArray]:
    """Draw the crossing (1, 2) from which each robot starts. Another robot changes nothing for those before it."""
    crossings = _Ways(plan).crossings
    return [frozen(crossings[rng.integers(len(crossings))][None]) for _ in range(robots)]


def plan_walk(plan: FloorPlan, start: FloatArray, length_m: float, rng: np.random.Generator) -> FloatArray:
    """Plan waypoints (K, 2) of a walk of about ``length_m`` metres along the ways of a yard.

    The walk prefers ways that it has driven least, returns to ``start`` (1, 2) before its end, and goes on along its
    first ways for what is left.
    """
    ways = _Ways(plan)
    home = int(np.argmin(np.linalg.norm(ways.crossings - start, axis=1)))
    walk, driven_m, times = [home], 0.0, np.zeros_like(ways.lengths_m)
    while True:
        here = walk[-1]
        to = np.flatnonzero(np.isfinite(ways.lengths_m[here]))
        to = to[driven_m + ways.lengths_m[here, to] + ways.home_m(home)[to] <= length_m]
        to = to[to != walk[-2]] if len(walk) > 1 and np.any(to != walk[-2]) else to
        if not len(to):
            break
        cost = times[here, to] + rng.uniform(0.0, 1.0, len(to))
        there = int(to[np.argmin(cost)])
        times[here, there] += 1.0
        times[there, here] += 1.0
        driven_m += float(ways.lengths_m[here, there])
        walk.append(there)
    walk += ways.path(walk[-1], home)[1:]
    if len(walk) == 1:
        # Too short for a tour: there and back.
        walk += [int(np.argmin(ways.lengths_m[home])), home]
    corners = ways.crossings[[*walk, *walk[1:]]]
    return _swayed(_resampled(corners, length_m), rng)


class _Ways:
    """Crossings and the ways between them."""

    def __init__(self, plan: FloorPlan) -> None:
        ends = np.array(plan.lanes).reshape(-1, 2)
        self.crossings, index = np.unique(ends, axis=0, return_inverse=True)
        a, b = index.reshape(-1, 2).T
        count = len(self.crossings)
        self.lengths_m: FloatArray = np.full((count, count), np.inf)
        """Lengths of the ways from crossing to crossing; infinite without a way."""
        self.lengths_m[a, b] = self.lengths_m[b, a] = np.linalg.norm(self.crossings[a] - self.crossings[b], axis=1)
        graph = csr_array(np.where(np.isfinite(self.lengths_m), self.lengths_m, 0.0))
        self._shortest, self._before = dijkstra(graph, return_predecessors=True)

    def home_m(self, home: int) -> FloatArray:
        """Distances of all crossings from ``home``."""
        return np.asarray(self._shortest[home])

    def path(self, start: int, end: int) -> list[int]:
        """Crossings of the shortest path, both ends included."""
        path = [end]
        while path[-1] != start:
            path.append(int(self._before[start, path[-1]]))
        return path[::-1]


def _resampled(corners: FloatArray, length_m: float) -> FloatArray:
    """The first ``length_m`` of an open polygon as points (N, 2), a step apart."""
    driven = np.insert(np.cumsum(np.linalg.norm(np.diff(corners, axis=0), axis=1)), 0, 0.0)
    at = np.append(np.arange(0.0, min(length_m, driven[-1]), _STEP_M), min(length_m, driven[-1]))
    return np.column_stack([np.interp(at, driven, column) for column in corners.T])


def _swayed(path: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Let a path (N, 2) sway to both sides, and round its corners."""
    along = np.gradient(_smooth(path, _CORNER_M), axis=0)
    along /= np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-9)
    sway = _smooth(rng.standard_normal((len(path), 1)), _SWAY_LENGTH_M)
    sway = np.clip(sway * _SWAY_M / max(float(sway.std()), 1e-9), -_SWAY_LIMIT_M, _SWAY_LIMIT_M)
    return frozen(_smooth(path + sway * along[:, ::-1] * (-1.0, 1.0), _CORNER_M))


def _smooth(path: FloatArray, reach_m: float) -> FloatArray:
    return np.asarray(gaussian_filter1d(path, reach_m / _STEP_M, axis=0, mode="nearest"))
