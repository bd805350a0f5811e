"""A floor plan: outlines of walls, doors and furniture.

A random generator draws the sizes, so that corridors differ, but doors repeat as in real buildings. Coordinates are
metres in the coordinate frame ``building``, whose origin is the south-west corner.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from itertools import pairwise

import numpy as np

from fcslam.lab.simulation.layouts import Lane, Layout, Row, draw_layout
from fcslam.lab.simulation.options import Building
from fcslam.records import FloatArray, frozen

WALL_M = 0.12
"""Thickness of a wall."""
DOOR_M = 1.0
"""Width of a door."""
CLEARANCE_M = 0.5
"""Distance of furniture from the centre lines of corridors and the entrances of rooms."""

DISC_CORNERS = 8
"""Corners of the outline of a round piece."""

_ATTEMPTS = 20
"""Attempts to place a piece of furniture before it is omitted."""


class PieceKind(StrEnum):
    """Kinds of pieces."""

    WALL = "wall"
    CABINET = "cabinet"
    COLUMN = "column"
    LINTEL = "lintel"
    """The wall above a door; robots and LiDAR beams pass under it."""


@dataclass(frozen=True, slots=True)
class Piece:
    """A wall or a piece of furniture, seen from above."""

    kind: StrEnum
    """``PieceKind``, or that of another world."""
    outline: FloatArray
    """Corners counter-clockwise, metres: (8, 2) of a ``disc``, else (4, 2) of a rectangle or (K, 2) of a polygon."""

    @property
    def centre(self) -> FloatArray:
        """Centre, shape (2,)."""
        return np.asarray(self.outline.mean(axis=0))

    @property
    def size(self) -> tuple[float, float]:
        """Length and width, metres; of a disc the diameter twice."""
        if len(self.outline) == DISC_CORNERS:
            diameter = float(np.linalg.norm(self.outline[4] - self.outline[0]))
            return diameter, diameter
        sides = np.linalg.norm(np.diff(self.outline[:3], axis=0), axis=1)
        return float(sides[0]), float(sides[1])

    @property
    def heading_rad(self) -> float:
        """Direction of the first side."""
        along = self.outline[1] - self.outline[0]
        return float(np.arctan2(along[1], along[0]))


@dataclass(frozen=True, slots=True)
class Room:
    """A room with one door and a straight entrance path that furniture keeps clear of."""

    doorway: FloatArray
    """Start of the entrance path, on the corridor's centre line in front of the door, shape (2,)."""
    inside: FloatArray
    """End of the entrance path, shape (2,)."""
    low: FloatArray
    """The south-west corner, shape (2,)."""
    high: FloatArray
    """The north-east corner, shape (2,)."""

    def contains(self, points: FloatArray) -> bool:
        """Whether one of the points (N, 2) lies in the room."""
        return bool(np.any(np.all((points > self.low) & (points < self.high), axis=1)))


@dataclass(frozen=True, slots=True)
class FloorPlan:
    """Obstacles, corridors and rooms of one floor."""

    size_m: tuple[float, float]
    """From west to east and from south to north."""
    pieces: tuple[Piece, ...]
    segments: FloatArray
    """Sides of walls and furniture at the laser's height: x1 y1 x2 y2, shape (S, 4)."""
    lanes: tuple[Lane, ...]
    """Centre lines of the corridors, which meet at their ends."""
    rooms: tuple[Room, ...]


def draw_floor_plan(rng: np.random.Generator, building: Building = Building.DEFAULT) -> FloorPlan:
    """Draw a building, by default about 22 m by 17 m; the same generator state gives the same one."""
    return build(draw_layout(building, rng), rng)


def build(layout: Layout, rng: np.random.Generator) -> FloorPlan:
    """Build walls, doors and furniture for a layout."""
    walls = [_wall(0, 0, layout.width, 0), _wall(0, layout.height, layout.width, layout.height)]
    walls += [_wall(x, 0, x, layout.height) for x in (0.0, layout.width)]
    pieces = [Piece(PieceKind.WALL, outline) for outline in walls]
    rooms: list[Room] = []
    for row in layout.rows:
        row_pieces, row_rooms = _build_row(row, layout, rng)
        pieces += row_pieces
        rooms += row_rooms
    pieces += _corridor_cabinets(layout, [(room.doorway, room.inside) for room in rooms], rng)
    size_m = (layout.width, layout.height)
    return FloorPlan(size_m, tuple(pieces), segments_of(pieces), layout.lanes, tuple(rooms))


def move_furniture(
    plan: FloorPlan, share: float, rng: np.random.Generator, visited: FloatArray | None = None
) -> FloorPlan:
    """Shift and turn a ``share`` of the furniture in rooms a little.

    Every piece stays in its room and clear of the entrance; a piece without such a position stays where it was. With
    ``visited``, positions of shape (N, 2), only the rooms that contain one of them change.
    """
    moved = [
        _moved(piece, room, rng)
        if (room := _room_of(piece, plan)) and rng.random() < share and (visited is None or room.contains(visited))
        else piece
        for piece in plan.pieces
    ]
    return replace(plan, pieces=tuple(moved), segments=segments_of(moved))


def _moved(piece: Piece, room: Room, rng: np.random.Generator) -> Piece:
    centre, margin = piece.centre, 0.5 * float(np.hypot(*piece.size))
    for _ in range(_ATTEMPTS):
        place = centre + rng.normal(0.0, 0.4, 2)
        turned = (piece.outline - centre) @ rotation(rng.normal(0.0, 0.3))
        fits = np.all(place > room.low + margin) and np.all(place < room.high - margin)
        if fits and distance_m(place, (room.doorway, room.inside)) > CLEARANCE_M + margin:
            return Piece(piece.kind, frozen(turned + place))
    return piece


def _room_of(piece: Piece, plan: FloorPlan) -> Room | None:
    if piece.kind not in (PieceKind.CABINET, PieceKind.COLUMN):
        return None
    centre = piece.centre
    inside = (room for room in plan.rooms if np.all(centre > room.low) and np.all(centre < room.high))
    return next(inside, None)


def _build_row(row: Row, layout: Layout, rng: np.random.Generator) -> tuple[list[Piece], list[Room]]:
    shares = np.cumsum(np.ones(row.rooms) if layout.alike else rng.uniform(0.75, 1.25, row.rooms))
    edges = row.x[0] + (row.x[1] - row.x[0]) * np.insert(shares / shares[-1], 0, 0.0)
    walls = [_wall(row.x[0], row.back, row.x[1], row.back)]
    walls += [_wall(edge, row.back, edge, row.front) for edge in edges]
    pieces = [Piece(PieceKind.WALL, outline) for outline in walls]
    rooms = []
    low, high = sorted((row.front, row.back))
    for west, east in pairwise(edges):
        across = 0.5 if layout.alike else rng.uniform(0.25, 0.75)
        door = float(np.clip(west + across * (east - west), *layout.door_limits))
        left, right = door - DOOR_M / 2.0, door + DOOR_M / 2.0
        pieces.append(Piece(PieceKind.WALL, _wall(west, row.front, left, row.front)))
        pieces.append(Piece(PieceKind.WALL, _wall(right, row.front, east, row.front)))
        pieces.append(Piece(PieceKind.LINTEL, _wall(left, row.front, right, row.front)))
        depth = row.front + rng.uniform(0.45, 0.65) * (row.back - row.front)
        corner_low, corner_high = np.array([west, low]), np.array([east, high])
        room = Room(frozen([door, row.lane]), frozen([door, depth]), frozen(corner_low), frozen(corner_high))
        pieces += _furniture(room, rng)
        rooms.append(room)
    return pieces, rooms


def _furniture(room: Room, rng: np.random.Generator) -> list[Piece]:
    path = (room.doorway, room.inside)
    pieces = []
    for _ in range(rng.integers(2, 5)):
        size = rng.uniform((0.4, 0.3), (1.6, 0.8))
        margin = 0.5 * float(np.hypot(*size))
        column = rng.random() < 0.25
        outline = disc(size[1] / 2.0) if column else rectangle(size, rng.normal(0.0, 0.15))
        for _ in range(_ATTEMPTS):
            centre = rng.uniform(room.low + margin, room.high - margin)
            if distance_m(centre, path) > CLEARANCE_M + margin:
                pieces.append(Piece(PieceKind.COLUMN if column else PieceKind.CABINET, frozen(outline + centre)))
                break
    return pieces


def _corridor_cabinets(layout: Layout, paths: list[Lane], rng: np.random.Generator) -> list[Piece]:
    """Cabinets along the walls of corridors. Without them, a corridor would not constrain the position along it."""
    pieces = []
    for _ in range(layout.cabinets):
        lane = rng.integers(len(layout.lanes))
        start, end = layout.lanes[lane]
        along = (end - start) / np.linalg.norm(end - start)
        length, depth = rng.uniform((0.4, 0.2), (1.2, 0.35))
        aside = rng.choice((-1.0, 1.0)) * (layout.corridor - WALL_M - depth) / 2.0
        centre = start + rng.uniform(0.15, 0.85) * (end - start) + aside * np.array([-along[1], along[0]])
        ways = [*paths, *(other for k, other in enumerate(layout.lanes) if k != lane)]
        if all(distance_m(centre, way) > CLEARANCE_M + length / 2.0 for way in ways):
            outline = rectangle((length, depth), float(np.arctan2(along[1], along[0]))) + centre
            pieces.append(Piece(PieceKind.CABINET, frozen(outline)))
    return pieces


def segments_of(pieces: Sequence[Piece]) -> FloatArray:
    """Sides of all pieces at the laser's height, shape (S, 4)."""
    return frozen(np.concatenate([_sides(piece.outline) for piece in pieces if piece.kind is not PieceKind.LINTEL]))


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


def rectangle(size: Sequence[float] | FloatArray, heading_rad: float) -> FloatArray:
    """Outline of a rectangle around the origin, shape (4, 2)."""
    corners = np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]]) * np.asarray(size)
    return np.asarray(corners @ rotation(heading_rad))


def rotation(heading_rad: float) -> FloatArray:
    """Rotation matrix (2, 2) to multiply points (N, 2) by from the right."""
    cos, sin = np.cos(heading_rad), np.sin(heading_rad)
    return np.array([[cos, sin], [-sin, cos]])


def disc(radius: float) -> FloatArray:
    """Outline of a round piece around the origin, shape (8, 2)."""
    angles = np.arange(DISC_CORNERS) * np.pi / 4.0
    return radius * np.column_stack((np.cos(angles), np.sin(angles)))


def _sides(outline: FloatArray) -> FloatArray:
    """The sides of a closed outline (K, 2) as segments (K, 4)."""
    return np.hstack((outline, np.roll(outline, -1, axis=0)))


def distance_m(point: FloatArray, path: Lane) -> float:
    """Distance of a point from the segment between two others."""
    start, end = path
    along = end - start
    share = np.clip((point - start) @ along / (along @ along), 0.0, 1.0)
    return float(np.linalg.norm(point - start - share * along))
