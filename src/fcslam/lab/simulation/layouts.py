"""Layouts of corridors and rooms for four kinds of building, drawn from a random generator.

    default
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

`flat` and `corridor` are one corridor with rooms on both sides; `office` is a grid of corridors around blocks of rooms.
Coordinates are metres in the coordinate frame ``building``, whose origin is the south-west corner.
"""

from dataclasses import dataclass

import numpy as np

from fcslam.lab.simulation.options import Building
from fcslam.records import FloatArray

Lane = tuple[FloatArray, FloatArray]
"""Both ends (2,) of a corridor's centre line, metres."""


@dataclass(frozen=True, slots=True)
class Row:
    """Rooms side by side whose doors open to one corridor."""

    x: tuple[float, float]
    """West and east end."""
    back: float
    """y of the wall away from the corridor."""
    front: float
    """y of the wall with the doors."""
    lane: float
    """y of the corridor's centre line."""
    rooms: int


@dataclass(frozen=True, slots=True)
class Layout:
    """Corridors and rows of rooms of a building; lengths in metres."""

    width: float
    height: float
    corridor: float
    """Width of every corridor."""
    rows: tuple[Row, ...]
    lanes: tuple[Lane, ...]
    door_limits: tuple[float, float]
    """Lowest and highest x of a door."""
    cabinets: int
    """Attempts to place a cabinet in a corridor."""
    alike: bool = False
    """Whether all rooms have one size and a door in the middle."""


def draw_layout(building: Building, rng: np.random.Generator) -> Layout:
    """Draw a layout; the same generator state gives the same one."""
    if building is Building.DEFAULT:
        return _two_loops(rng)
    if building is Building.OFFICE:
        return _grid(rng)
    if building is Building.FLAT:
        depths = (rng.uniform(3.4, 4.2), rng.uniform(3.4, 4.2))
        return _one_corridor(rng.uniform(9.5, 11.5), rng.uniform(1.6, 1.9), depths, rooms=(2, 3), cabinets=3)
    return _one_corridor(rng.uniform(34.0, 37.0), 2.2, (4.5, 4.5), rooms=(10, 10), cabinets=0, alike=True)


def _two_loops(rng: np.random.Generator) -> Layout:
    """About 22 m by 17 m."""
    corridor = rng.uniform(2.0, 2.4)
    south = rng.uniform(3.6, 4.6)
    low, high = south + corridor, south + corridor + rng.uniform(3.6, 4.4)
    north = high + corridor
    width = rng.uniform(21.0, 24.0)
    height, cross = north + rng.uniform(4.2, 5.4), rng.uniform(8.5, 10.5)
    half = corridor / 2.0
    lanes_x, lanes_y = (half, cross + half, width - half), (south + half, high + half)
    rows = [
        Row((0.0, width), 0.0, south, lanes_y[0], rooms=4),
        Row((0.0, width), height, north, lanes_y[1], rooms=4),
    ]
    for west, east in ((corridor, cross), (cross + corridor, width - corridor)):
        split = west + rng.uniform(0.4, 0.6) * (east - west)
        rows.append(Row((west, split), high, low, lanes_y[0], rooms=1))
        rows.append(Row((split, east), low, high, lanes_y[1], rooms=1))
    doors = (corridor, width - corridor)
    return Layout(width, height, corridor, tuple(rows), _lanes(lanes_x, lanes_y), doors, cabinets=14)


def _grid(rng: np.random.Generator) -> Layout:
    """60 m by 40 m: two rows of blocks between three corridors, each block two rooms deep."""
    width, height, corridor, blocks = 60.0, 40.0, 2.2, 3
    south, north = rng.uniform(4.6, 5.4, 2)
    deep = (height - south - north - 3 * corridor) / 2.0
    # South walls of the corridors from west to east, and west walls of those from south to north.
    walls_y = (south, south + corridor + deep, height - north - corridor)
    edges = np.linspace(0.0, width - corridor, blocks + 1)
    edges[1:-1] += rng.uniform(-1.5, 1.5, blocks - 1)
    half = corridor / 2.0
    lanes_x, lanes_y = tuple(float(edge) + half for edge in edges), tuple(wall + half for wall in walls_y)
    rows = [
        Row((0.0, width), 0.0, south, lanes_y[0], rooms=12),
        Row((0.0, width), height, height - north, lanes_y[2], rooms=12),
    ]
    for west, east in zip(edges[:-1] + corridor, edges[1:], strict=True):
        for below, above in ((0, 1), (1, 2)):
            low, high = walls_y[below] + corridor, walls_y[above]
            middle = low + rng.uniform(0.45, 0.55) * (high - low)
            x = (float(west), float(east))
            rows.append(Row(x, middle, low, lanes_y[below], rooms=int(rng.integers(3, 5))))
            rows.append(Row(x, middle, high, lanes_y[above], rooms=int(rng.integers(3, 5))))
    doors = (corridor, width - corridor)
    return Layout(width, height, corridor, tuple(rows), _lanes(lanes_x, lanes_y), doors, cabinets=40)


def _one_corridor(
    width: float,
    corridor: float,
    depths: tuple[float, float],
    rooms: tuple[int, int],
    cabinets: int,
    alike: bool = False,
) -> Layout:
    south, north = depths
    half = corridor / 2.0
    lane, height = south + half, south + corridor + north
    rows = (
        Row((0.0, width), 0.0, south, lane, rooms=rooms[0]),
        Row((0.0, width), height, south + corridor, lane, rooms=rooms[1]),
    )
    ends = (np.array([1.0, lane]), np.array([width - 1.0, lane]))
    return Layout(width, height, corridor, rows, (ends,), (1.0, width - 1.0), cabinets, alike)


def _lanes(lanes_x: tuple[float, ...], lanes_y: tuple[float, ...]) -> tuple[Lane, ...]:
    across = [(np.array([lanes_x[0], y]), np.array([lanes_x[-1], y])) for y in lanes_y]
    along = [(np.array([x, lanes_y[0]]), np.array([x, lanes_y[-1]])) for x in lanes_x]
    return (*across, *along)
