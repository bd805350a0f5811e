"""A walled ramp: level, down, through a hollow, up and level again, with walls on both sides.

In the hollow the scan plane meets the ground across the whole front, and this line of returns travels with the robot.
The walls are bare but for a few pillars, so little else tells how far the robot drives.
"""

from itertools import pairwise

import numpy as np

from fcslam.lab.simulation.floorplan import FloorPlan, Piece, PieceKind, disc, rectangle, segments_of
from fcslam.lab.simulation.layouts import Lane
from fcslam.lab.simulation.terrain import CELL_M, Terrain, draw_bumps
from fcslam.records import frozen

WALL_M = 3.0
"""Distance of the walls from the centre line."""

_SIZE_M = (130.0, 40.0)
_LANE = (10.0, 65.0, 120.0)
"""Ends and middle of the way in x."""
_SLOPE_AT = ((25.0, 0.0), (35.0, -1.0), (45.0, -1.0), (85.0, 1.0), (95.0, 1.0), (105.0, 0.0))
"""Slope at some x, as a share of the steepest; linear in between."""
_WALL_X = (25.0, 105.0)
_PILLARS_M = (9.0, 20.0)
"""Shortest and longest distance of pillars along a wall."""
_TRUNKS = 24


def draw_ramp(rng: np.random.Generator, slope: float, bumps: float = 0.0) -> FloorPlan:
    """Draw a ramp of 80 m between two groups of trees; the same generator state gives the same one.

    Args:
        rng: source of trees, pillars and bumps.
        slope: slope of the steepest parts.
        bumps: share of the ground that is a bump.
    """
    middle = 0.5 * _SIZE_M[1]
    pieces = []
    for side in (-1.0, 1.0):
        y = middle + side * (WALL_M + 0.15)
        wall = rectangle((_WALL_X[1] - _WALL_X[0], 0.3), 0.0) + np.array((0.5 * sum(_WALL_X), y))
        pieces.append(Piece(PieceKind.WALL, frozen(wall)))
        x = _WALL_X[0] + rng.uniform(0.0, _PILLARS_M[1])
        while x < _WALL_X[1]:
            pillar = rectangle((0.4, 0.6), 0.0) + np.array((x, middle + side * WALL_M))
            pieces.append(Piece(PieceKind.WALL, frozen(pillar)))
            x += rng.uniform(*_PILLARS_M)
    for k in range(_TRUNKS):  # half of them at each end, on both sides of the way
        x = rng.uniform(1.0, _WALL_X[0] - 1.0) + (_WALL_X[1] if k % 2 else 0.0)
        y = middle + rng.choice((-1.0, 1.0)) * rng.uniform(WALL_M, 0.45 * _SIZE_M[1])
        pieces.append(Piece(PieceKind.TRUNK, frozen(disc(rng.uniform(0.1, 0.35)) + np.array((x, y)))))
    lanes: tuple[Lane, ...] = tuple(
        (frozen(np.array((a, middle))), frozen(np.array((b, middle)))) for a, b in pairwise(_LANE)
    )
    at, share = np.array(_SLOPE_AT).T
    along = np.arange(0.0, _SIZE_M[0] + 2.0 * CELL_M, CELL_M)
    profile = np.insert(np.cumsum(slope * CELL_M * np.interp(along[:-1] + 0.5 * CELL_M, at, share)), 0, 0.0)
    heights = np.tile(profile, (int(_SIZE_M[1] / CELL_M) + 2, 1))
    terrain = Terrain(frozen(heights), draw_bumps(_SIZE_M, rng, bumps))
    return FloorPlan(_SIZE_M, tuple(pieces), segments_of(pieces), lanes, (), terrain)
