"""Appearance of a building: materials, heights of furniture and pictures, the same for all robots; and its light."""

from dataclasses import dataclass

import numpy as np

from fcslam.lab.simulation import textures
from fcslam.lab.simulation.floorplan import WALL_M, FloorPlan, Piece, PieceKind, Room
from fcslam.lab.simulation.options import Lighting
from fcslam.lab.simulation.textures import Image
from fcslam.records import FloatArray, frozen

WALL_HEIGHT_M = 2.5
DOOR_HEIGHT_M = 2.05
_WALLS, _FLOORS, _FRONTS = 8, 6, 10
"""Number of different walls, floors and furniture fronts. Every picture is unique."""
_PICTURE_OFF_M = WALL_M / 2.0 + 0.01

LAMP_HEIGHT_M = WALL_HEIGHT_M - 0.1


@dataclass(frozen=True, slots=True)
class WallPicture:
    """A picture or a sign on a wall."""

    image: Image
    centre: tuple[float, float, float]
    """In ``building``, metres."""
    size: tuple[float, float]
    """Width and height, metres."""
    heading_rad: float
    """Direction of its width."""


@dataclass(frozen=True, slots=True)
class Decoration:
    """The appearance of a building, which only cameras see."""

    walls: tuple[Image, ...]
    floors: tuple[Image, ...]
    fronts: tuple[Image, ...]
    """Fronts of furniture."""
    corridor_floor: Image
    ceiling: Image
    looks: tuple[int, ...]
    """Index into ``walls`` or ``fronts`` for each piece of the floor plan."""
    heights_m: tuple[float, ...]
    """Height of each piece of the floor plan."""
    room_floors: tuple[int, ...]
    """Index into ``floors`` for each room."""
    pictures: tuple[WallPicture, ...]


def decorate(plan: FloorPlan, rng: np.random.Generator) -> Decoration:
    """Draw the appearance of everything; a piece keeps its appearance when furniture moves."""
    floors = [(textures.planks, textures.tiles, textures.carpet)[k % 3](rng) for k in range(_FLOORS)]
    looks = [int(rng.integers(_WALLS if _is_wall(piece) else _FRONTS)) for piece in plan.pieces]
    heights = [_height_m(piece, rng) for piece in plan.pieces]
    pictures = [picture for room in plan.rooms for picture in _pictures(room, rng)]
    return Decoration(
        walls=tuple(textures.plaster(rng) for _ in range(_WALLS)),
        floors=tuple(floors),
        fronts=tuple(textures.cupboard(rng) for _ in range(_FRONTS)),
        corridor_floor=textures.tiles(rng),
        ceiling=textures.tiles(rng),
        looks=tuple(looks),
        heights_m=tuple(heights),
        room_floors=tuple(int(k) for k in rng.integers(_FLOORS, size=len(plan.rooms))),
        pictures=tuple(pictures),
    )


def _is_wall(piece: Piece) -> bool:
    return piece.kind in (PieceKind.WALL, PieceKind.LINTEL)


def _height_m(piece: Piece, rng: np.random.Generator) -> float:
    if _is_wall(piece) or (piece.kind is PieceKind.COLUMN and rng.random() < 0.5):
        return WALL_HEIGHT_M
    return float(rng.uniform(0.6, 1.9))  # always above the mounting height of a laser


def _pictures(room: Room, rng: np.random.Generator) -> list[WallPicture]:
    inward = float(np.sign(room.inside[1] - room.doorway[1]))
    front, back = (room.low[1], room.high[1]) if inward > 0 else (room.high[1], room.low[1])
    (west, _), (east, _) = room.low, room.high
    pictures = []
    for wall in rng.permutation(3)[: rng.integers(2, 4)]:
        size = rng.uniform((0.7, 0.5), (1.3, 0.95))
        if wall == 0:
            x = _between(west, east, size[0], rng)
            pictures.append(_hang((x, back - inward * _PICTURE_OFF_M), size, 0.0, rng))
        else:
            side = west + _PICTURE_OFF_M if wall == 1 else east - _PICTURE_OFF_M
            y = _between(room.low[1], room.high[1], size[0], rng)
            pictures.append(_hang((side, y), size, np.pi / 2.0, rng))
    outside, door = front - inward * _PICTURE_OFF_M, float(room.doorway[0])
    sign = textures.door_sign(rng)
    pictures.append(WallPicture(sign, (door + 0.72, outside, 1.45), (0.24, 0.24), 0.0))
    for low, high in ((west, door - 0.6), (door + 0.9, east)):
        size = rng.uniform((0.6, 0.5), (1.1, 0.9))
        if high - low > size[0] + 0.3 and rng.random() < 0.6:
            pictures.append(_hang((_between(low, high, size[0], rng), outside), size, 0.0, rng))
    return pictures


def _between(low: float, high: float, width: float, rng: np.random.Generator) -> float:
    """Draw the coordinate of a picture's centre on a wall from ``low`` to ``high``."""
    margin = 0.5 * width + 0.1
    return float(rng.uniform(low + margin, high - margin))


def _hang(place: tuple[float, float], size: FloatArray, heading_rad: float, rng: np.random.Generator) -> WallPicture:
    centre = (float(place[0]), float(place[1]), float(rng.uniform(1.2, 1.5)))
    width, height = frozen(size).tolist()
    return WallPicture(textures.picture(rng), centre, (width, height), heading_rad)


@dataclass(frozen=True, slots=True)
class Light:
    """The light during one robot's recording."""

    lamps: FloatArray
    """Positions of the working lamps in ``building``, shape (L, 3), metres."""
    lamp_rgb: tuple[float, float, float]
    """Intensity of a lamp, each colour in [0, 1]."""
    ambient_rgb: tuple[float, float, float]
    """Intensity of the ambient light, each colour in [0, 1]."""


def light_of(plan: FloorPlan, lighting: Lighting, rng: np.random.Generator) -> Light:
    """Light a building; the generator chooses the lamps that fail."""
    lamps = _lamps(plan)
    if lighting is Lighting.EVENING:
        return Light(lamps, (0.52, 0.40, 0.24), (0.14, 0.11, 0.09))
    if lighting is Lighting.LAMP_OFF:
        failed = rng.choice(len(lamps), max(1, len(lamps) // 3), replace=False)
        lamps = frozen(np.delete(lamps, failed, axis=0))
    return Light(lamps, (0.34, 0.34, 0.32), (0.40, 0.41, 0.44))


def _lamps(plan: FloorPlan) -> FloatArray:
    """Positions of lamps, one in the middle of every room and some along each corridor, shape (L, 3)."""
    points = [(room.low + room.high) / 2.0 for room in plan.rooms]
    for start, end in plan.lanes:
        count = max(2, round(float(np.linalg.norm(end - start)) / 6.0) + 1)  # one every six metres
        points += [start + share * (end - start) for share in np.linspace(0.0, 1.0, count)]
    return frozen(np.column_stack((np.array(points), np.full(len(points), LAMP_HEIGHT_M))))
