"""A drawn floor plan: rooms with doors around corridors that form two loops, with furniture, as line segments.

    +--------+------+----------+------+      north rooms
    |        |      |          |      |
    +--  ----+-  ---+---  -----+-  ---+
    |                                 |      north corridor
    |  +----+-  --+   +--+---  ----+  |
    |  |    |     |   |  |         |  |      core; west, cross and east corridor
    |  +-  -+-----+   +  +---------+  |
    |                                 |      south corridor
    +-----  ----+--  ----+----  --+-  +
    |           |        |        |   |
    +-----------+--------+--------+---+      south rooms

Its sizes are drawn by a random generator, so that no two corridors are alike, but the doors repeat as in any building.
Coordinates are metres in the coordinate frame ``building``, whose origin is the south-west corner.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from fcslam.records import FloatArray, frozen

WALL_M = 0.12
DOOR_M = 1.0
CLEARANCE_M = 0.5
"""Furniture keeps this far from where robots drive."""

CORRIDOR_CABINETS = 14
_ATTEMPTS = 20
"""Tries to place a piece of furniture before it is left out."""


@dataclass(frozen=True, slots=True)
class Room:
    """A room that a robot visits by driving straight through its door."""

    doorway: FloatArray
    """The point on the corridor's centre line in front of the door, shape (2,)."""
    inside: FloatArray
    """Where a visitor turns, shape (2,)."""


@dataclass(frozen=True, slots=True)
class FloorPlan:
    """What reflects a laser beam, and where robots can drive."""

    segments: FloatArray
    """Ends x1 y1 x2 y2 of every side of a wall or a piece of furniture, shape (S, 4)."""
    loops: tuple[FloatArray, ...]
    """Corners (4, 2) of the closed walks along the corridors: the west loop, the east loop, around both."""
    rooms: tuple[Room, ...]


@dataclass(frozen=True, slots=True)
class _Sizes:
    """The numbers that make this building different from the next, metres from its south-west corner."""

    width: float
    corridor: float
    south: float
    """Front wall of the south rooms."""
    core: tuple[float, float]
    """South and north wall of the core."""
    north: float
    """Front wall of the north rooms."""
    height: float
    cross: float
    """West wall of the cross corridor."""

    @classmethod
    def draw(cls, rng: np.random.Generator) -> "_Sizes":
        corridor = rng.uniform(2.0, 2.4)
        south = rng.uniform(3.6, 4.6)
        core = (south + corridor, south + corridor + rng.uniform(3.6, 4.4))
        north = core[1] + corridor
        width = rng.uniform(21.0, 24.0)
        return cls(width, corridor, south, core, north, north + rng.uniform(4.2, 5.4), rng.uniform(8.5, 10.5))

    @property
    def lanes_x(self) -> tuple[float, float, float]:
        """Centre lines of the west, cross and east corridor."""
        half = self.corridor / 2.0
        return half, self.cross + half, self.width - half

    @property
    def lanes_y(self) -> tuple[float, float]:
        """Centre lines of the south and north corridor."""
        half = self.corridor / 2.0
        return self.south + half, self.core[1] + half


@dataclass(frozen=True, slots=True)
class _Row:
    """Rooms side by side whose doors open to one corridor."""

    x: tuple[float, float]
    back: float
    front: float
    lane: float
    rooms: int


def draw_floor_plan(rng: np.random.Generator) -> FloorPlan:
    """A building of about 22 m by 17 m; the same generator state gives the same building."""
    sizes = _Sizes.draw(rng)
    pieces = [_wall(0, 0, sizes.width, 0), _wall(0, sizes.height, sizes.width, sizes.height)]
    pieces += [_wall(x, 0, x, sizes.height) for x in (0.0, sizes.width)]
    rooms: list[Room] = []
    for row in _rows(sizes, rng):
        walls, row_rooms = _build_row(row, (sizes.corridor, sizes.width - sizes.corridor), rng)
        pieces += walls
        rooms += row_rooms
    paths = [(room.doorway, room.inside) for room in rooms]
    pieces += _corridor_cabinets(sizes, paths, rng)
    return FloorPlan(frozen(np.concatenate([_sides(piece) for piece in pieces])), _loops(sizes), tuple(rooms))


def _rows(sizes: _Sizes, rng: np.random.Generator) -> list[_Row]:
    south_lane, north_lane = sizes.lanes_y
    low, high = sizes.core
    rows = [
        _Row((0.0, sizes.width), 0.0, sizes.south, south_lane, rooms=4),
        _Row((0.0, sizes.width), sizes.height, sizes.north, north_lane, rooms=4),
    ]
    blocks = ((sizes.corridor, sizes.cross), (sizes.cross + sizes.corridor, sizes.width - sizes.corridor))
    for west, east in blocks:
        split = west + rng.uniform(0.4, 0.6) * (east - west)
        rows.append(_Row((west, split), high, low, south_lane, rooms=1))
        rows.append(_Row((split, east), low, high, north_lane, rooms=1))
    return rows


def _build_row(
    row: _Row, door_limits: tuple[float, float], rng: np.random.Generator
) -> tuple[list[FloatArray], list[Room]]:
    """Outlines of the walls and furniture of a row, and its rooms."""
    shares = np.cumsum(rng.uniform(0.75, 1.25, row.rooms))
    edges = row.x[0] + (row.x[1] - row.x[0]) * np.insert(shares / shares[-1], 0, 0.0)
    pieces = [_wall(row.x[0], row.back, row.x[1], row.back)]
    pieces += [_wall(edge, row.back, edge, row.front) for edge in edges]
    rooms = []
    for west, east in pairwise(edges):
        door = float(np.clip(west + rng.uniform(0.25, 0.75) * (east - west), *door_limits))
        pieces.append(_wall(west, row.front, door - DOOR_M / 2.0, row.front))
        pieces.append(_wall(door + DOOR_M / 2.0, row.front, east, row.front))
        depth = row.front + rng.uniform(0.45, 0.65) * (row.back - row.front)
        room = Room(frozen([door, row.lane]), frozen([door, depth]))
        pieces += _furniture((west, east), sorted((row.front, row.back)), room, rng)
        rooms.append(room)
    return pieces, rooms


def _furniture(x: tuple[float, float], y: Sequence[float], room: Room, rng: np.random.Generator) -> list[FloatArray]:
    """A few tables, cabinets and columns that leave the way through the door free."""
    path = (room.doorway, room.inside)
    pieces = []
    for _ in range(rng.integers(2, 5)):
        size = rng.uniform((0.4, 0.3), (1.6, 0.8))
        margin = 0.5 * float(np.hypot(*size))
        outline = _column(size[1] / 2.0) if rng.random() < 0.25 else _rectangle(size, rng.normal(0.0, 0.15))
        for _ in range(_ATTEMPTS):
            centre = rng.uniform((x[0] + margin, y[0] + margin), (x[1] - margin, y[1] - margin))
            if _distance(centre, path) > CLEARANCE_M + margin:
                pieces.append(outline + centre)
                break
    return pieces


def _corridor_cabinets(
    sizes: _Sizes, paths: list[tuple[FloatArray, FloatArray]], rng: np.random.Generator
) -> list[FloatArray]:
    """Cabinets along the corridors' walls: without them a corridor would not tell how far along it a robot is."""
    lanes = [(np.array([sizes.lanes_x[0], y]), np.array([sizes.lanes_x[2], y])) for y in sizes.lanes_y]
    lanes += [(np.array([x, sizes.lanes_y[0]]), np.array([x, sizes.lanes_y[1]])) for x in sizes.lanes_x]
    pieces = []
    for _ in range(CORRIDOR_CABINETS):
        lane = rng.integers(len(lanes))
        start, end = lanes[lane]
        along = (end - start) / np.linalg.norm(end - start)
        length, depth = rng.uniform((0.4, 0.2), (1.2, 0.35))
        aside = rng.choice((-1.0, 1.0)) * (sizes.corridor - WALL_M - depth) / 2.0
        centre = start + rng.uniform(0.15, 0.85) * (end - start) + aside * np.array([-along[1], along[0]])
        ways = [*paths, *(other for k, other in enumerate(lanes) if k != lane)]
        if all(_distance(centre, way) > CLEARANCE_M + length / 2.0 for way in ways):
            pieces.append(_rectangle((length, depth), float(np.arctan2(along[1], along[0]))) + centre)
    return pieces


def _loops(sizes: _Sizes) -> tuple[FloatArray, ...]:
    (south, north), (west, cross, east) = sizes.lanes_y, sizes.lanes_x
    return tuple(
        frozen([[left, south], [right, south], [right, north], [left, north]])
        for left, right in ((west, cross), (cross, east), (west, east))
    )


def _wall(x1: float, y1: float, x2: float, y2: float) -> FloatArray:
    """Outline of a straight wall along an axis, shape (4, 2)."""
    (left, right), (low, high), half = sorted((x1, x2)), sorted((y1, y2)), WALL_M / 2.0
    return np.array(
        [
            [left - half, low - half],
            [right + half, low - half],
            [right + half, high + half],
            [left - half, high + half],
        ]
    )


def _rectangle(size: Sequence[float] | FloatArray, heading_rad: float) -> FloatArray:
    """Outline of a rectangle around the origin, shape (4, 2)."""
    corners = np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]]) * np.asarray(size)
    cos, sin = np.cos(heading_rad), np.sin(heading_rad)
    return np.asarray(corners @ np.array([[cos, sin], [-sin, cos]]))


def _column(radius: float) -> FloatArray:
    """Outline of an octagonal column around the origin, shape (8, 2)."""
    angles = np.arange(8) * np.pi / 4.0
    return radius * np.column_stack((np.cos(angles), np.sin(angles)))


def _sides(outline: FloatArray) -> FloatArray:
    """The sides of a closed outline (K, 2) as segments (K, 4)."""
    return np.hstack((outline, np.roll(outline, -1, axis=0)))


def _distance(point: FloatArray, path: tuple[FloatArray, FloatArray]) -> float:
    """Distance of a point from the segment between two others."""
    start, end = path
    along = end - start
    share = np.clip((point - start) @ along / (along @ along), 0.0, 1.0)
    return float(np.linalg.norm(point - start - share * along))
