"""A yard: buildings from outside, lawns, car parks and open ground, with ways between and around them.

Blocks of 20 to 32 m lie in a grid; ways run along all of them and meet at their corners. Each block is a building, a
lawn with trees, a car park or open ground. Lamps, trees, hedges, cars, signs and bins stand beside the ways. Most
sides of the yard are closed by houses, a hedge, a fence or a low wall; beyond the others are a few trees, or nothing.
Everything keeps clear of the ways.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from fcslam.lab.simulation.floorplan import (
    FloorPlan,
    Piece,
    disc,
    distance_m,
    rectangle,
    rotation,
    segments_of,
)
from fcslam.lab.simulation.layouts import Lane
from fcslam.lab.simulation.simulated_fleet import World
from fcslam.records import FloatArray, frozen

from .outdoor_rays import OutdoorRayCaster
from .walk import draw_starts, plan_walk
from .yard_plan import SLOPE, YardKind, YardPlan, draw_terrain

CLEARANCE_M = 1.7
"""Distance of everything from the centre line of a way."""

_AROUND_M = 18.0
"""Width of the strip around the blocks and their ways."""
_BLOCK_M, _WAY_M = (20.0, 32.0), (7.0, 10.0)
_CROSSING_M = 1.2
"""Largest shift of a crossing of ways in x and y."""
_FACADE_M = 0.3
"""Thickness of a facade."""
_CAR_M, _BAY_M = (4.4, 1.8), (5.0, 2.6)
"""Length and width of a parked car and of its bay."""
_BENCH_M = (1.8, 0.45)
_PARKED = 0.65
"""Share of bays with a car."""


class _Block(tuple[float, float, float, float]):
    """West, south, east and north."""


@dataclass(frozen=True, slots=True)
class _Site:
    """Lists of objects that grow while a yard is drawn."""

    lanes: tuple[Lane, ...]
    rng: np.random.Generator
    pieces: list[Piece]

    def stand(self, kind: YardKind, outline: FloatArray) -> bool:
        """Add a piece if it keeps clear of the ways."""
        centre, radius = outline.mean(axis=0), float(np.linalg.norm(outline - outline.mean(axis=0), axis=1).max())
        points = _along(outline, 0.5) if radius > 0.5 else centre[None]
        margin = CLEARANCE_M if radius > 0.5 else CLEARANCE_M + radius
        near = [lane for lane in self.lanes if distance_m(centre, lane) < margin + radius]
        if any(distance_m(point, lane) < margin for lane in near for point in points):
            return False
        self.pieces.append(Piece(kind, frozen(outline)))
        return True

    def disc(self, kind: YardKind, centre: FloatArray, radius: float) -> bool:
        """Add a round piece if it keeps clear of the ways."""
        return self.stand(kind, disc(radius) + centre)


class Yard(World):
    """A yard as the world of a fleet, for LiDARs."""

    def __init__(self, slope: float = SLOPE) -> None:
        """``slope``: root mean square in each direction."""
        self._slope = slope

    def draw(self, rng: np.random.Generator) -> YardPlan:
        return draw_yard(rng, self._slope)

    def goals(self, plan: FloorPlan, robots: int, length_m: float, rng: np.random.Generator) -> list[FloatArray]:  # noqa: ARG002
        return draw_starts(plan, robots, rng)

    def changed(self, plan: YardPlan, goals: FloatArray, share: float, rng: np.random.Generator) -> YardPlan:  # noqa: ARG002
        return move_cars(plan, share, rng)

    def route(self, plan: FloorPlan, goals: FloatArray, length_m: float, rng: np.random.Generator) -> FloatArray:
        return plan_walk(plan, goals, length_m, rng)

    def caster(self, plan: YardPlan) -> OutdoorRayCaster:
        return OutdoorRayCaster(plan)


def draw_yard(rng: np.random.Generator, slope: float = SLOPE) -> YardPlan:
    """Draw a yard of 70 to 120 m in each direction; the same generator state gives the same one.

    ``slope`` describes its ground as in ``draw_terrain``; it changes nothing else.
    """
    columns, rows = rng.permutation((2, 3)) if rng.random() < 0.6 else (3, 3)
    xs, x_lanes = _axis(int(columns), rng)
    ys, y_lanes = _axis(int(rows), rng)
    size_m = (float(x_lanes[-1]) + _AROUND_M, float(y_lanes[-1]) + _AROUND_M)
    blocks = [_Block((west, south, east, north)) for south, north in ys for west, east in xs]
    uses = _uses(len(blocks), rng)
    crossings = np.stack(np.meshgrid(x_lanes, y_lanes), axis=-1)
    crossings = crossings + rng.uniform(-_CROSSING_M, _CROSSING_M, crossings.shape)
    site = _Site(_ways(crossings, uses, rng), rng, [])
    draw = {"building": _building, "lawn": _lawn, "parking": _parking, "open": _open}
    for block, use in zip(blocks, uses, strict=True):
        draw[use](block, site)
    for block in blocks:
        _beside_ways(block, site)
    _around(size_m, site)
    terrain = draw_terrain(size_m, rng, slope)
    return YardPlan(size_m, tuple(site.pieces), segments_of(site.pieces), site.lanes, (), terrain)


def move_cars(plan: YardPlan, share: float, rng: np.random.Generator) -> YardPlan:
    """Let a ``share`` of the parked cars drive away."""
    stays = tuple(piece for piece in plan.pieces if piece.kind is not YardKind.CAR or rng.random() >= share)
    return replace(plan, pieces=stays, segments=segments_of(stays))


def _axis(count: int, rng: np.random.Generator) -> tuple[list[tuple[float, float]], FloatArray]:
    """Both ends of the blocks along one axis, and the centre lines of the ways between and around them."""
    ways, blocks = rng.uniform(*_WAY_M, count + 1), rng.uniform(*_BLOCK_M, count)
    starts = _AROUND_M + np.cumsum(ways)[:-1] + np.insert(np.cumsum(blocks), 0, 0.0)[:-1] - 0.5 * ways[0]
    ends = starts + blocks
    lanes = np.append(starts - 0.5 * ways[:-1], ends[-1] + 0.5 * ways[-1])
    return [(float(a), float(b)) for a, b in zip(starts, ends, strict=True)], lanes


def _uses(count: int, rng: np.random.Generator) -> list[str]:
    """A use for each block; every yard has buildings, a lawn, a car park and open ground."""
    sure = ["building", "building", "lawn", "parking", "open"]
    more = rng.choice(("building", "lawn", "parking", "open"), count - len(sure), p=(0.4, 0.3, 0.15, 0.15))
    return [str(use) for use in rng.permutation([*sure, *more])]


def _ways(crossings: FloatArray, uses: list[str], rng: np.random.Generator) -> tuple[Lane, ...]:
    """Ways along all blocks from crossing to crossing, shape (rows, columns, 2), and across open blocks."""
    rows, columns = crossings.shape[:2]
    lanes = [(crossings[i, j], crossings[i, j + 1]) for i in range(rows) for j in range(columns - 1)]
    lanes += [(crossings[i, j], crossings[i + 1, j]) for i in range(rows - 1) for j in range(columns)]
    for number, use in enumerate(uses):
        i, j = divmod(number, columns - 1)
        if use == "open" or (use == "lawn" and rng.random() < 0.4):
            falling = bool(rng.random() < 0.5)
            lanes.append((crossings[i + falling, j], crossings[i + 1 - falling, j + 1]))
    return tuple((frozen(start), frozen(end)) for start, end in lanes)


def _building(block: _Block, site: _Site) -> None:
    """A house with bays, recesses and glass fronts, and walls behind the glass."""
    rng = site.rng
    inset = rng.uniform(0.5, 4.0, 4)
    corners = np.array(block) + inset * (1.0, 1.0, -1.0, -1.0)
    turn = float(rng.choice((0.0, rng.normal(0.0, 0.12))))
    middle = 0.5 * (corners[:2] + corners[2:])
    size = (corners[2:] - corners[:2]) * (1.0 - abs(np.sin(turn)))
    for side in range(4):
        heading = turn + side * 0.5 * np.pi
        length, depth = (size[0], size[1]) if side % 2 == 0 else (size[1], size[0])
        _front(site, float(length), heading, middle, -0.5 * float(depth))
        inner = -0.5 * depth + 3.5
        end = 0.5 * length - 3.5
        _wall_between(site, YardKind.WALL, (-end, inner), (end, inner), heading, middle)


def _front(site: _Site, length: float, heading_rad: float, middle: FloatArray, across: float) -> None:
    """One side of a house, in axes of ``heading_rad`` around ``middle``: ``across`` from it, recesses to the left."""
    for a, b, offset, kind in _facade(length, site.rng):
        y = across + offset
        _wall_between(site, kind, (a - 0.5 * length, y), (b - 0.5 * length, y), heading_rad, middle)


def _facade(length: float, rng: np.random.Generator) -> Iterator[tuple[float, float, float, YardKind]]:
    """Walls along and across one side: start and end along it, depth behind its line, kind. Across, start is end."""
    at, before = 0.0, 0.0
    recesses, fronts = rng.uniform(0.1, 0.4), rng.uniform(0.05, 0.4)
    while at < length:
        end = min(at + rng.uniform(1.2, 5.5), length)
        if length - end < 1.5:
            end = length
        first_or_last = at == 0.0 or end == length
        depth = float(rng.uniform(0.2, 1.6)) if not first_or_last and rng.random() < recesses else 0.0
        kind = YardKind.GLASS if rng.random() < fronts else YardKind.WALL
        if depth != before:
            for k in np.arange(min(depth, before), max(depth, before), _FACADE_M):
                yield at - 0.5 * _FACADE_M, at + 0.5 * _FACADE_M, float(k), YardKind.WALL
        yield at, end, depth, kind
        at, before = end, depth


def _wall_between(
    site: _Site,
    kind: YardKind,
    start: tuple[float, float],
    end: tuple[float, float],
    heading_rad: float,
    middle: FloatArray,
) -> None:
    """A straight wall; its ends are in axes of ``heading_rad`` around ``middle``."""
    along = np.array([end[0] - start[0], _FACADE_M])
    outline = rectangle(along, 0.0) + 0.5 * (np.array(start) + np.array(end))
    site.stand(kind, outline @ rotation(heading_rad) + middle)


def _lawn(block: _Block, site: _Site) -> None:
    """Trees at random, a bench or two, bushes, and often a hedge around a part."""
    rng = site.rng
    for centre in _scattered(block, int(rng.integers(4, 15)), 2.5, rng):
        site.disc(YardKind.TRUNK, centre, float(rng.uniform(0.08, 0.35)))
    for centre in _scattered(block, int(rng.integers(0, 6)), 3.0, rng):
        _bush(centre, site)
    for centre in _scattered(block, int(rng.integers(0, 3)), 3.0, rng):
        site.stand(YardKind.LOW_WALL, rectangle(_BENCH_M, rng.uniform(0.0, np.pi)) + centre)
    for side in rng.permutation(4)[: rng.integers(0, 3)]:
        _hedge(*_side(block, int(side), 1.0), site)


def _parking(block: _Block, site: _Site) -> None:
    """Rows of cars, two and two back to back, sometimes with trees between them."""
    rng = site.rng
    west, south, east, north = block
    row, between = south + 0.5 + 0.5 * _BAY_M[0], bool(rng.random() < 0.5)
    while row < north - 0.5 * _BAY_M[0]:
        for pair in range(2):
            y = row + pair * (_BAY_M[0] + 0.8)
            if y > north - 0.5 * _BAY_M[0]:
                break
            for x in np.arange(west + 2.0, east - 1.5, _BAY_M[1]):
                if rng.random() < _PARKED:
                    _car(np.array([x, y]), 0.5 * np.pi, site)
        if between:
            for x in np.arange(west + 2.0, east - 1.5, 3.0 * _BAY_M[1]):
                site.disc(YardKind.TRUNK, np.array([x - 0.5 * _BAY_M[1], row + 0.5 * _BAY_M[0] + 0.4]), 0.12)
        row += 2.0 * _BAY_M[0] + 0.8 + 6.0


def _open(block: _Block, site: _Site) -> None:
    """Nothing but perhaps a few lamps."""
    for centre in _scattered(block, int(site.rng.integers(0, 3)), 6.0, site.rng):
        site.disc(YardKind.COLUMN, centre, 0.08)


def _beside_ways(block: _Block, site: _Site) -> None:
    """Lamps, trees, hedges, cars or bollards along the sides of a block."""
    rng = site.rng
    for side in range(4):
        start, end = _side(block, side, -0.6)
        kind = rng.choice(("lamps", "trees", "hedge", "cars", "bollards", "nothing"), p=(0.3, 0.2, 0.1, 0.1, 0.1, 0.2))
        if kind == "hedge":
            share = rng.uniform(0.0, 0.5)
            _hedge(start + share * (end - start), end, site)
        elif kind == "cars":
            heading = float(np.arctan2(*(end - start)[::-1]))
            for centre in _spaced(start, end, 6.5, 0.4, rng):
                if rng.random() < _PARKED:
                    _car(centre, heading, site)
        elif kind != "nothing":
            piece, spacing, spread, radius = {
                "lamps": (YardKind.COLUMN, 16.0, 1.0, 0.08),
                "trees": (YardKind.TRUNK, 6.5, 0.5, 0.2),
                "bollards": (YardKind.BOLLARD, 2.2, 0.05, 0.07),
            }[str(kind)]
            for centre in _spaced(start, end, spacing * rng.uniform(0.8, 1.25), spread, rng):
                site.disc(piece, centre, radius * float(rng.uniform(0.7, 1.5)))
        for centre in _spaced(start, end, 7.0, 2.0, rng):
            _clutter(centre, site)


def _clutter(centre: FloatArray, site: _Site) -> None:
    """A traffic sign, a bin, a cabinet of a power line, a bench, a bush, or nothing."""
    rng = site.rng
    kind = rng.choice(("sign", "bin", "cabinet", "bench", "bush", "nothing"), p=(0.15, 0.12, 0.08, 0.08, 0.07, 0.5))
    if kind == "sign":
        site.disc(YardKind.COLUMN, centre, 0.04)
    elif kind == "bin":
        site.disc(YardKind.BOLLARD, centre, float(rng.uniform(0.2, 0.35)))
    elif kind == "cabinet":
        site.stand(YardKind.CABINET, rectangle((float(rng.uniform(0.6, 1.4)), 0.35), rng.uniform(0.0, np.pi)) + centre)
    elif kind == "bench":
        site.stand(YardKind.LOW_WALL, rectangle(_BENCH_M, rng.uniform(0.0, np.pi)) + centre)
    elif kind == "bush":
        _bush(centre, site)


def _around(size_m: tuple[float, float], site: _Site) -> None:
    """Draw the border of the yard and the objects beyond it."""
    rng = site.rng
    inner = _Block((_AROUND_M, _AROUND_M, size_m[0] - _AROUND_M, size_m[1] - _AROUND_M))
    kinds = ("hedge", "fence", "low wall", "trees", "facade", "nothing")
    for side in range(4):
        start, end = _side(inner, side, -float(rng.uniform(3.5, 6.0)))
        kind = rng.choice(kinds, p=(0.2, 0.15, 0.15, 0.15, 0.15, 0.2))
        if kind == "hedge":
            _hedge(start, end, site)
        elif kind in ("fence", "low wall"):
            length = float(np.linalg.norm(end - start))
            outline = rectangle((length, 0.1 if kind == "fence" else 0.3), float(np.arctan2(*(end - start)[::-1])))
            site.stand(YardKind(str(kind)), outline + 0.5 * (start + end))
        elif kind == "facade":
            heading = float(np.arctan2(*(start - end)[::-1]))
            _front(site, float(np.linalg.norm(end - start)), heading, 0.5 * (start + end), 0.0)
        elif kind == "trees":
            for centre in _spaced(start, end, 7.0, 1.5, rng):
                site.disc(YardKind.TRUNK, centre, float(rng.uniform(0.1, 0.35)))
    for _ in range(int(rng.integers(10, 40))):
        point = rng.uniform(1.0, np.array(size_m) - 1.0)
        if np.any(point < _AROUND_M - 6.0) or np.any(point > np.array(size_m) - _AROUND_M + 6.0):
            site.disc(YardKind.TRUNK, point, float(rng.uniform(0.1, 0.35)))


def _hedge(start: FloatArray, end: FloatArray, site: _Site) -> None:
    """A ragged row of bushes, here and there with a gap."""
    rng = site.rng
    radius = rng.uniform(0.35, 0.6)
    for centre in _spaced(start, end, 0.9 * radius, 0.12, rng):
        if rng.random() > 0.04:
            site.disc(YardKind.HEDGE, centre, radius * float(rng.uniform(0.75, 1.25)))


def _bush(centre: FloatArray, site: _Site) -> None:
    """A few overlapping discs of leaves."""
    for _ in range(int(site.rng.integers(3, 8))):
        place = centre + site.rng.normal(0.0, 0.5, 2)
        site.disc(YardKind.HEDGE, place, float(site.rng.uniform(0.3, 0.8)))


def _car(centre: FloatArray, heading_rad: float, site: _Site) -> None:
    rng = site.rng
    half = 0.5 * np.array(_CAR_M) * rng.uniform((0.85, 0.92), (1.1, 1.05))
    corner = np.array([0.55, 0.3])
    quarter = np.array([half - (0.0, corner[1]), half - 0.3 * corner, half - (corner[0], 0.0)])
    ends = [quarter, quarter[::-1] * (-1.0, 1.0), -quarter, quarter[::-1] * (1.0, -1.0)]
    place = centre + rng.normal(0.0, (0.2, 0.2))
    site.stand(YardKind.CAR, np.concatenate(ends) @ rotation(heading_rad + rng.normal(0.0, 0.04)) + place)


def _side(block: _Block, side: int, inside_m: float) -> tuple[FloatArray, FloatArray]:
    """Ends of the south, east, north or west side of a block, moved inwards."""
    west, south, east, north = np.array(block) + inside_m * np.array([1.0, 1.0, -1.0, -1.0])
    corners = np.array([[west, south], [east, south], [east, north], [west, north]])
    return corners[side], corners[(side + 1) % 4]


def _spaced(
    start: FloatArray, end: FloatArray, spacing_m: float, spread_m: float, rng: np.random.Generator
) -> FloatArray:
    """Points (N, 2) along a line, about ``spacing_m`` apart."""
    length = float(np.linalg.norm(end - start))
    shares = (np.arange(max(1, int(length / spacing_m))) + 0.5) * spacing_m / length
    points = start + shares[:, None] * (end - start)
    return np.asarray(points + rng.normal(0.0, 0.5 * spread_m, points.shape))


def _scattered(block: _Block, count: int, apart_m: float, rng: np.random.Generator) -> FloatArray:
    """Up to ``count`` random points (N, 2) in a block that are ``apart_m`` from each other."""
    points: list[FloatArray] = []
    for point in rng.uniform(np.array(block[:2]) + 1.0, np.array(block[2:]) - 1.0, (3 * count, 2)):
        if len(points) < count and all(np.linalg.norm(point - other) > apart_m for other in points):
            points.append(point)
    return np.array(points).reshape(-1, 2)


def _along(outline: FloatArray, step_m: float) -> NDArray[np.float64]:
    """Points (N, 2) along the sides of an outline."""
    sides = np.roll(outline, -1, axis=0) - outline
    parts = [
        corner + np.linspace(0.0, 1.0, 2 + int(np.linalg.norm(side) / step_m))[:-1, None] * side
        for corner, side in zip(outline, sides, strict=True)
    ]
    return np.concatenate(parts)
