"""Casts the beams of a LiDAR outdoors: what stands in a yard returns beams partly, and the scan plane follows slopes.

A beam meets surfaces one after the other, each with its height above the ground, and passes those that are too low, too
high or too thin for it. Foliage returns it at a random depth. Glass returns it, mirrors it or lets it through. A beam
that reaches the ground ends there. Far, dark or grazed surfaces return too little light.
"""

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fcslam.compiled import njit
from fcslam.geometry import se2
from fcslam.lab.simulation.floorplan import Piece
from fcslam.records import FloatArray, LaserModel

from .yard_plan import CELL_M as TERRAIN_CELL_M
from .yard_plan import ROUND, YardKind, YardPlan

LASER_HEIGHT_M: Final = 0.5

_CELL_M: Final = 2.0
"""Side of a cell of the grid that finds the surfaces along a beam."""
_SHAKE_RAD: Final = 0.002
"""Standard deviation of pitch and roll on rough ground."""
_BEAM_HALF_WIDTH_RAD: Final = 0.0015
"""A beam returns from anywhere in its width."""
_LEAST_M: Final = 1e-4
_NOTHING: Final = -1
_GROUND: Final = -2
_GROUND_RETURNS: Final = 0.75
"""Share of beams that return from near ground. The others graze it and are lost."""
_GROUND_REFLECTIVITY: Final = 0.1
"""Reflectivity of ground that beams graze."""
_GROUND_ROUGHNESS: Final = 0.04
"""Relative error of a range to the ground."""
_GLASS_PASSES: Final = 0.5
_GLASS_MIRRORS: Final = 0.3
_GLASS_FACED: Final = 0.98
"""Cosine of the incidence above which glass returns every beam."""
_LEAST_COSINE: Final = 0.1
"""Roughness of walls: even a grazing beam meets something that faces it as much."""


class Layer(NamedTuple):
    """How a piece returns beams between two heights above the ground."""

    low_m: float
    high_m: float
    opacity: float
    """Share of beams that do not pass."""
    reflectivity: float
    """The largest range falls with the square root of it."""
    free_path_m: float = 0.0
    """Mean depth in foliage from which a beam returns."""
    glass: bool = False


LAYERS: Final = {
    YardKind.WALL: (Layer(0.0, 8.0, 1.0, 0.5),),
    YardKind.GLASS: (Layer(0.0, 2.5, 1.0, 0.5, glass=True), Layer(2.5, 8.0, 1.0, 0.5)),
    YardKind.COLUMN: (Layer(0.0, 4.0, 1.0, 0.5),),
    YardKind.CABINET: (Layer(0.0, 1.1, 1.0, 0.5),),
    YardKind.TRUNK: (Layer(0.0, 3.0, 1.0, 0.3),),
    YardKind.BOLLARD: (Layer(0.0, 0.9, 1.0, 0.5),),
    YardKind.LOW_WALL: (Layer(0.0, 0.6, 1.0, 0.5),),
    YardKind.HEDGE: (Layer(0.0, 1.3, 1.0, 0.3, free_path_m=0.18),),
    YardKind.FENCE: (Layer(0.0, 1.6, 0.5, 0.5),),
    YardKind.CAR: (Layer(0.2, 0.85, 0.95, 0.3), Layer(0.85, 1.4, 0.4, 0.3)),
}
"""Objects in a yard, from the ground upwards."""


class _World(NamedTuple):
    """Arrays for compiled code."""

    surfaces: FloatArray
    """Shape (S, 10): 1 for a disc; x1 y1 x2 y2 of a side, or x y radius 0; the layer's fields."""
    first: NDArray[np.int64]
    """Start of each cell's part of ``members``, shape (cells + 1,)."""
    members: NDArray[np.int64]
    """Surfaces that lie in a cell."""
    columns: int
    rows: int
    heights_m: FloatArray


class OutdoorRayCaster:
    """Casts beams in a yard."""

    def __init__(self, plan: YardPlan) -> None:
        """Index everything that stands on ``plan``."""
        self._terrain = plan.terrain
        self._world = _world(plan)

    def cast(self, T_building_base: FloatArray, laser: LaserModel) -> FloatArray:
        """Ranges (beam_count,) in metres on level ground, as if everything returned every beam.

        The pose (3,) of the robot, or its poses at each beam, shape (beam_count, 3).
        """
        return self._cast(T_building_base, laser, np.zeros(2), None)

    def scan(self, T_building_base: FloatArray, laser: LaserModel, rng: np.random.Generator) -> FloatArray:
        """Ranges (beam_count,) in metres without noise, as ``cast``; ``max_range_m`` without a return."""
        tilt = self._terrain.slope(np.atleast_2d(T_building_base)[0, :2]) + rng.normal(0.0, _SHAKE_RAD, 2)
        return self._cast(T_building_base, laser, tilt, int(rng.integers(2**62)))

    def _cast(self, T_building_base: FloatArray, laser: LaserModel, tilt: FloatArray, seed: int | None) -> FloatArray:
        x, y, heading = se2.compose(T_building_base, np.array(laser.T_base_laser)).T
        angles = heading + laser.angles_rad()
        origins = np.stack(np.broadcast_arrays(x, y, angles)[:2], axis=1)
        ideal, far = seed is None, laser.max_range_m
        return np.asarray(_cast_beams(origins, angles, tilt, far, np.uint64(seed or 0), ideal, self._world))


def _world(plan: YardPlan) -> _World:
    surfaces = np.array([row for piece in plan.pieces for row in _rows(piece)])
    columns, rows = (int(np.ceil(size / _CELL_M)) for size in plan.size_m)
    cells, members = [], []
    for number, (disc, *ends) in enumerate(surfaces[:, :5]):
        corners = _box(ends) if disc else np.array(ends).reshape(2, 2)
        low, high = (
            np.clip(np.floor(f(corners, axis=0) / _CELL_M), 0, (columns - 1, rows - 1)).astype(int)
            for f in (np.min, np.max)
        )
        block = np.add.outer(np.arange(low[1], high[1] + 1) * columns, np.arange(low[0], high[0] + 1)).ravel()
        cells.append(block)
        members.append(np.full(len(block), number))
    cell, member = np.concatenate(cells), np.concatenate(members)
    order = np.argsort(cell, kind="stable")
    first = np.searchsorted(cell[order], np.arange(columns * rows + 1))
    return _World(surfaces, first, member[order], columns, rows, np.ascontiguousarray(plan.terrain.heights_m))


def _rows(piece: Piece) -> list[list[float]]:
    layers = [[float(value) for value in layer] for layer in LAYERS[piece.kind]]
    if piece.kind in ROUND:
        return [[1.0, *piece.centre, 0.5 * piece.size[0], 0.0, *layer[:5]] for layer in layers]
    if piece.kind is YardKind.GLASS:
        # One pane along the middle, or beams would have to pass two.
        long = 0 if piece.size[0] >= piece.size[1] else 1
        a, b, c, d = np.roll(piece.outline, -long, axis=0)
        sides = np.hstack((0.5 * (a + d), 0.5 * (b + c)))[None]
    else:
        sides = np.hstack((piece.outline, np.roll(piece.outline, -1, axis=0)))
    # A side is no foliage, so the last column says instead whether it is glass.
    return [[0.0, *side, *layer[:4], layer[5]] for side in sides for layer in layers]


def _box(disc: list[float]) -> FloatArray:
    """Opposite corners (2, 2) around a disc: x, y, radius."""
    x, y, radius, _ = disc
    return np.array([[x - radius, y - radius], [x + radius, y + radius]])


@njit(nogil=True)
def _uniform(seed, beam, number):  # type: ignore[no-untyped-def]
    """A number in [0, 1) that depends on nothing else: SplitMix64 of its arguments."""
    z = seed + np.uint64(beam) * np.uint64(0xD1342543DE82EF95) + np.uint64(number + 8) * np.uint64(0x9E3779B97F4A7C15)
    for _ in range(2):
        z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
        z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
        z = z ^ (z >> np.uint64(31))
    return (z >> np.uint64(11)) * (1.0 / 9007199254740992.0)


@njit(nogil=True)
def _ground_m(heights, x, y):  # type: ignore[no-untyped-def]
    """Height of the ground."""
    column = min(max(x / TERRAIN_CELL_M, 0.0), heights.shape[1] - 1.001)
    row = min(max(y / TERRAIN_CELL_M, 0.0), heights.shape[0] - 1.001)
    j, i = int(column), int(row)
    across, up = column - j, row - i
    below = heights[i, j] + across * (heights[i, j + 1] - heights[i, j])
    above = heights[i + 1, j] + across * (heights[i + 1, j + 1] - heights[i + 1, j])
    return below + up * (above - below)


@njit(nogil=True)
def _meet(surface, x, y, dx, dy, depth):  # type: ignore[no-untyped-def]
    """Distance along a beam and cosine of the incidence where it meets a surface; infinite where it does not."""
    if surface[0] > 0.0:
        ahead = (surface[1] - x) * dx + (surface[2] - y) * dy
        aside = (surface[1] - x) * dy - (surface[2] - y) * dx
        square = surface[3] ** 2 - aside**2
        if square <= 0.0:
            return np.inf, 1.0
        half = np.sqrt(square)
        enters = max(ahead - half, 0.0)
        if ahead + half <= _LEAST_M or depth > ahead + half - enters:
            return np.inf, 1.0
        return enters + depth, 1.0
    ex, ey = surface[3] - surface[1], surface[4] - surface[2]
    sx, sy = surface[1] - x, surface[2] - y
    determinant = dx * ey - dy * ex
    if abs(determinant) < 1e-12:
        return np.inf, 1.0
    along = (sx * dy - sy * dx) / determinant
    distance = (sx * ey - sy * ex) / determinant
    if distance <= _LEAST_M or along < 0.0 or along > 1.0:
        return np.inf, 1.0
    return distance, abs(determinant) / np.hypot(ex, ey)


@njit(nogil=True)
def _passes(surface, above_m, facing, chance):  # type: ignore[no-untyped-def]
    """Whether a beam goes on where it meets a surface, ``above_m`` over the ground; ``chance`` lies in [0, 1)."""
    if above_m < surface[5] or above_m > surface[6]:
        return True
    glass = surface[0] == 0.0 and surface[9] > 0.0
    return chance < (_GLASS_PASSES if glass and facing < _GLASS_FACED else 1.0 - surface[7])


@njit(nogil=True)
def _first_hit(start, direction, far, seed, beam, ideal, world):  # type: ignore[no-untyped-def]
    """Distance, surface and cosine of the incidence where a beam ends: cell after cell along it."""
    x, y, z = start
    dx, dy, dz = direction
    column, row = int(x / _CELL_M), int(y / _CELL_M)
    step_x, step_y = (1 if dx > 0.0 else -1), (1 if dy > 0.0 else -1)
    wide = _CELL_M / abs(dx) if dx != 0.0 else np.inf
    high = _CELL_M / abs(dy) if dy != 0.0 else np.inf
    next_x = ((column + (dx > 0.0)) * _CELL_M - x) / dx if dx != 0.0 else np.inf
    next_y = ((row + (dy > 0.0)) * _CELL_M - y) / dy if dy != 0.0 else np.inf
    best, hit, cosine = far, _NOTHING, 1.0
    entered, above_before = 0.0, z - _ground_m(world.heights_m, x, y)
    while 0 <= column < world.columns and 0 <= row < world.rows:
        cell = row * world.columns + column
        for k in range(world.first[cell], world.first[cell + 1]):
            number = world.members[k]
            surface = world.surfaces[number]
            depth = 0.0
            if surface[0] > 0.0 and surface[9] > 0.0 and not ideal:
                depth = -surface[9] * np.log(1.0 - _uniform(seed, beam, number))
            distance, facing = _meet(surface, x, y, dx, dy, depth)
            if distance >= best:
                continue
            above = z + distance * dz - _ground_m(world.heights_m, x + distance * dx, y + distance * dy)
            if not ideal and _passes(surface, above, facing, _uniform(seed + np.uint64(1), beam, number)):
                continue
            best, hit, cosine = distance, number, facing
        leaves = min(next_x, next_y)
        if not ideal:
            above_after = z + leaves * dz - _ground_m(world.heights_m, x + leaves * dx, y + leaves * dy)
            if above_after < 0.0:
                distance = entered + (leaves - entered) * above_before / (above_before - above_after)
                if distance < best:
                    best, hit, cosine = distance, _GROUND, 1.0
            above_before = above_after
        if best <= leaves or leaves >= far:
            break
        entered = leaves
        if next_x < next_y:
            next_x += wide
            column += step_x
        else:
            next_y += high
            row += step_y
    return best, hit, cosine


@njit(nogil=True)
def _cast_beams(origins, angles, tilt, far, seed, ideal, world):  # type: ignore[no-untyped-def]
    ranges = np.full(len(angles), far)
    for beam in range(len(angles)):
        x, y = origins[beam]
        height = _ground_m(world.heights_m, x, y) + LASER_HEIGHT_M
        angle = angles[beam]
        if not ideal:
            angle += _BEAM_HALF_WIDTH_RAD * (2.0 * _uniform(seed, beam, -1) - 1.0)
        dx, dy = np.cos(angle), np.sin(angle)
        dz = tilt[0] * dx + tilt[1] * dy
        start, before = (x, y, height), 0.0
        distance, hit, cosine = _first_hit(start, (dx, dy, dz), far, seed, beam, ideal, world)
        if hit >= 0 and world.surfaces[hit, 0] == 0.0 and world.surfaces[hit, 9] > 0.0 and not ideal:
            mirrors = _GLASS_MIRRORS / (1.0 - _GLASS_PASSES)
            if cosine < _GLASS_FACED and _uniform(seed, beam, -2) < mirrors:
                side = world.surfaces[hit]
                ex, ey = side[3] - side[1], side[4] - side[2]
                share = 2.0 * (dx * ex + dy * ey) / (ex * ex + ey * ey)
                start = (start[0] + distance * dx, start[1] + distance * dy, start[2] + distance * dz)
                dx, dy, before = share * ex - dx, share * ey - dy, distance
                distance, hit, cosine = _first_hit(start, (dx, dy, dz), far - before, seed, beam, ideal, world)
        if hit == _NOTHING:
            continue
        if hit == _GROUND:
            seen = before + distance < far * np.sqrt(_GROUND_REFLECTIVITY)
            if seen and _uniform(seed, beam, -3) < _GROUND_RETURNS:
                distance *= 1.0 + _GROUND_ROUGHNESS * (2.0 * _uniform(seed, beam, -4) - 1.0)
                ranges[beam] = min(before + distance, far)
            continue
        reach = far * np.sqrt(world.surfaces[hit, 8] * max(cosine, _LEAST_COSINE))
        if before + distance < reach:
            ranges[beam] = before + distance
    return ranges
