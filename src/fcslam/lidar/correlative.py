"""Correlative scan matching (Karto) by branch and bound (Hess et al., ICRA 2016): the global search.

The field is drawn as a likelihood grid. Each level of a pyramid holds the maximum over windows of 2^h cells, so one
look-up bounds the score of a whole square of shifts. Squares whose bound is below the best score are pruned.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fcslam.compiled import njit
from fcslam.lidar.field import SurfelField
from fcslam.lidar.scan import PointScan
from fcslam.lidar.submap import FREE_CELL_M, RADIUS_M
from fcslam.records import FloatArray

REACH_QUANTILE = 0.9
"""The angle step moves a point at this quantile of the distances by one cell."""
CELL_M = FREE_CELL_M
"""Side of a cell of the likelihood grid, and standard deviation of the likelihood around a surface, metres."""
MOST_LEVELS = 6
"""Most levels of the pyramid; a step on the coarsest one of them is 2^5 cells."""
MOST_POINTS = 120
"""Largest number of points that are scored."""


@dataclass(frozen=True, slots=True)
class SearchWindow:
    """Shifts of +- ``radius_m`` and turns of +- ``angle_rad`` around the guess."""

    radius_m: float
    angle_rad: float
    distance_penalty: float = 0.0
    angle_penalty: float = 0.0
    """Shares of the score lost at its edge and at the largest turn, as in Karto."""
    cell_m: float = CELL_M
    """Side of a cell of the likelihood grid, metres."""
    smear_m: float = CELL_M
    """Standard deviation of the likelihood around a surface, metres."""


@dataclass(frozen=True, slots=True)
class LikelihoodPyramid:
    """Likelihood of a surface in each cell, 0..255, and its maxima over growing windows."""

    levels: NDArray[np.uint8]
    """Shape (levels, H, W)."""
    corner: FloatArray
    """Lower left corner of the grid in the field's coordinates, shape (2,), metres."""
    cell_m: float


def likelihood_pyramid(
    field: SurfelField,
    T_field_guess: FloatArray,
    half_side_m: float,
    visible_only: bool = False,
    levels: int = MOST_LEVELS,
    cell_m: float = CELL_M,
    smear_m: float = CELL_M,
) -> LikelihoodPyramid:
    """Draw the surfaces around the guess, its centre, and build the pyramid of some ``levels``.

    ``visible_only`` draws only surfaces that face the guess (Karto's visibility filter), for one scan near the guess.
    """
    size = math.ceil(2.0 * half_side_m / cell_m) + 1
    corner = np.asarray(T_field_guess[:2]) - half_side_m
    surfels, count = field.arrays.surfels, int(field.arrays.used[1])
    viewpoint = np.array(T_field_guess[:2]) if visible_only else np.full(2, np.nan)
    smeared = math.ceil(2.5 * smear_m / cell_m)
    base = _draw(surfels, count, viewpoint, corner, size, cell_m, smear_m, smeared)
    return LikelihoodPyramid(_pyramid(base, levels), corner, cell_m)


def search(
    scan: PointScan,
    field: SurfelField,
    T_field_guess: FloatArray,
    window: SearchWindow,
    visible_only: bool = False,
    better_than: FloatArray | None = None,
) -> tuple[FloatArray, float]:
    """Find the best pose of a scan in a window around the guess, to half a cell and half an angle step.

    Returns it with its score: the mean likelihood of the points, in [0, 1], without the penalty. ``visible_only``
    matches only surfaces that face the guess. The result is ``better_than``, a pose in the window, if none exceeds its
    score, which prunes the search; it is the guess with score 0 if no pose puts a point on a surface.
    """
    cell_m = window.cell_m
    thinned = scan.thinned(cell_m, MOST_POINTS)
    reach = float(np.max(np.hypot(*thinned.points.T), initial=1.0))
    half_side = min(reach, RADIUS_M) + window.radius_m + cell_m
    usable = int(np.log2(window.radius_m / cell_m + 1.0)) + 1  # the levels that the window can use
    levels = min(MOST_LEVELS, max(1, usable))
    pyramid = likelihood_pyramid(field, T_field_guess, half_side, visible_only, levels, cell_m, window.smear_m)
    return search_pyramid(thinned, pyramid, T_field_guess, window, better_than)


def search_pyramid(
    scan: PointScan,
    pyramid: LikelihoodPyramid,
    T_field_guess: FloatArray,
    window: SearchWindow,
    better_than: FloatArray | None = None,
) -> tuple[FloatArray, float]:
    """As ``search``, on a pyramid that was built before; poses have shape (3,)."""
    reach = float(np.quantile(np.hypot(*scan.points.T), REACH_QUANTILE)) if len(scan) else 1.0
    step_rad = 2.0 * np.arcsin(min(0.5, 0.5 * pyramid.cell_m / max(reach, 1.0)))
    turns = math.ceil(window.angle_rad / step_rad)
    shifts = math.ceil(window.radius_m / pyramid.cell_m)
    guess = np.array(T_field_guess, dtype=np.float64)  # a writable copy: code is compiled once
    start = np.full(3, np.nan) if better_than is None else np.array(better_than)
    found: tuple[FloatArray, float] = _branch_and_bound(
        scan.points,
        pyramid.levels,
        pyramid.corner,
        pyramid.cell_m,
        guess,
        start,
        shifts,
        turns,
        step_rad,
        window.distance_penalty,
        window.angle_penalty,
    )
    return found


@njit
def _draw(surfels, count, viewpoint, corner, size, cell_m, smear_m, half):  # type: ignore[no-untyped-def]
    """Likelihood of the surfels that face the viewpoint, or of all if it is NaN; ``half`` a width in cells is drawn."""
    margin = 2 * half
    grid = np.zeros((size + 2 * margin, size + 2 * margin), np.uint8)  # with a margin on each side: no cell is outside
    across = np.empty(2 * half + 1)
    for i in range(count):
        x, y = surfels[i, 0], surfels[i, 1]
        if surfels[i, 2] * (viewpoint[0] - x) + surfels[i, 3] * (viewpoint[1] - y) < 0.0:
            continue
        cx, cy = int(np.floor((x - corner[0]) / cell_m)), int(np.floor((y - corner[1]) / cell_m))
        if cx < -half or cy < -half or cx >= size + half or cy >= size + half:
            continue
        for k in range(2 * half + 1):
            dx = corner[0] + (cx - half + k + 0.5) * cell_m - x
            across[k] = 255.0 * np.exp(-0.5 * dx * dx / (smear_m * smear_m))
        for j in range(2 * half + 1):
            dy = corner[1] + (cy - half + j + 0.5) * cell_m - y
            factor = np.exp(-0.5 * dy * dy / (smear_m * smear_m))
            row = grid[cy - half + j + margin]
            for k in range(2 * half + 1):
                cell = cx - half + k + margin
                row[cell] = max(row[cell], np.uint8(factor * across[k]))
    return grid[margin:-margin, margin:-margin].copy()


@njit
def _pyramid(base, count):  # type: ignore[no-untyped-def]
    """Level h at (y, x) is the maximum of ``base`` over [y, y + 2^h) x [x, x + 2^h)."""
    levels = np.empty((count, base.shape[0], base.shape[1]), np.uint8)
    rows, columns = base.shape
    for y in range(rows):
        for x in range(columns):
            levels[0, y, x] = base[y, x]
    for h in range(1, count):
        half = 1 << (h - 1)
        lower, upper = levels[h - 1], levels[h]
        inner = max(0, columns - half)
        highest = np.empty(columns, np.uint8)
        for y in range(rows):
            this, other, result = lower[y], lower[min(y + half, rows - 1)], upper[y]
            for x in range(columns):  # neither loop has a condition, so many cells are computed at a time
                highest[x] = max(this[x], other[x])
            right = highest[half:]
            for x in range(inner):
                result[x] = max(highest[x], right[x])
            for x in range(inner, columns):
                result[x] = max(highest[x], highest[columns - 1])
    return levels


@njit(allocates=False)
def _bound(cells, level, width, sx, sy, needed):  # type: ignore[no-untyped-def]
    """Sum of the points' largest likelihoods over shifts from (sx, sy) on, ``width`` cells; off the grid they are 0.

    If the sum does not exceed ``needed``, a part of it will do.
    """
    total = 0
    rows, columns = level.shape
    for i in range(len(cells)):
        x, y = cells[i, 0] + sx, cells[i, 1] + sy
        # A square that begins before the grid may reach into it.
        if x > -width and y > -width and x < columns and y < rows:
            total += level[max(y, 0), max(x, 0)]
        if total + 255 * (len(cells) - i) <= needed:
            return total
    return total


@njit
def _cells_of(points, pose, corner, cell, turn):  # type: ignore[no-untyped-def]
    cos, sin = np.cos(pose[2] + turn), np.sin(pose[2] + turn)
    cells = np.empty((len(points), 2), np.int64)
    for i in range(len(points)):
        x = pose[0] + cos * points[i, 0] - sin * points[i, 1]
        y = pose[1] + sin * points[i, 0] + cos * points[i, 1]
        cells[i, 0] = int(np.floor((x - corner[0]) / cell))
        cells[i, 1] = int(np.floor((y - corner[1]) / cell))
    return cells


@njit(allocates=False)
def _penalty(near, shifts, turn, turns, distance_penalty, angle_penalty):  # type: ignore[no-untyped-def]
    """Least penalty factor of a square of shifts whose nearest squared distance is ``near``."""
    away = distance_penalty * min(1.0, near / max(1, shifts * shifts))
    return (1.0 - away) * (1.0 - angle_penalty * (turn / max(1, turns)) ** 2)


@njit(allocates=False)
def _nearest(low, high):  # type: ignore[no-untyped-def]
    if low > 0:
        return low
    return -high if high < 0 else 0


@njit
def _branch_and_bound(  # type: ignore[no-untyped-def]
    points, levels, corner, cell, guess, start, shifts, turns, step, distance_penalty, angle_penalty
):
    n = max(1, len(points))
    top = len(levels) - 1
    while top > 0 and (1 << top) > shifts + 1:
        top -= 1
    width = 1 << top
    best = best_raw = 0.0
    best_pose = guess.copy()
    if not np.isnan(start[0]):
        best_raw = _bound(_cells_of(points, start, corner, cell, 0.0), levels[0], 1, 0, 0, -1.0) / (255.0 * n)
        near = ((start[0] - guess[0]) ** 2 + (start[1] - guess[1]) ** 2) / (cell * cell)
        turned = abs((start[2] - guess[2] + np.pi) % (2.0 * np.pi) - np.pi) / step
        best = best_raw * _penalty(near, shifts, turned, turns, distance_penalty, angle_penalty)
        best_pose = start.copy()
    stack = np.empty((4 * (top + 2), 3), np.int64)
    # Small turns first: an early good score prunes most of the rest.
    for order in range(2 * turns + 1):
        turn = (order + 1) // 2 if order % 2 else -(order // 2)
        cells = _cells_of(points, guess, corner, cell, turn * step)
        for y0 in range(-shifts, shifts + 1, width):
            for x0 in range(-shifts, shifts + 1, width):
                stack[0, 0], stack[0, 1], stack[0, 2] = x0, y0, top
                size = 1
                while size > 0:
                    size -= 1
                    sx, sy, h = stack[size, 0], stack[size, 1], stack[size, 2]
                    if sx > shifts or sy > shifts:  # the last squares overhang the window
                        continue
                    nx, ny = _nearest(sx, sx + (1 << h) - 1), _nearest(sy, sy + (1 << h) - 1)
                    near = nx * nx + ny * ny
                    penalty = _penalty(near, shifts, turn, turns, distance_penalty, angle_penalty)
                    needed = 255.0 * n * best / max(penalty, 1e-9)
                    raw = _bound(cells, levels[h], 1 << h, sx, sy, needed) / (255.0 * n)
                    score = raw * penalty
                    if score <= best:
                        continue
                    if h == 0:
                        best, best_raw = score, raw
                        best_pose[0] = guess[0] + sx * cell
                        best_pose[1] = guess[1] + sy * cell
                        best_pose[2] = (guess[2] + turn * step + np.pi) % (2.0 * np.pi) - np.pi
                        continue
                    half = 1 << (h - 1)
                    for k in range(4):
                        stack[size, 0] = sx + half * (k & 1)
                        stack[size, 1] = sy + half * (k >> 1)
                        stack[size, 2] = h - 1
                        size += 1
    return best_pose, best_raw
