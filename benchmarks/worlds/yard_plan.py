"""The plan of a yard: what stands there, and its sloping ground.

The ground tilts the robot and its scan plane, but poses stay those seen from above.
"""

from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from fcslam.lab.simulation.floorplan import FloorPlan
from fcslam.records import FloatArray, frozen

CELL_M = 1.0
"""Distance of neighbouring heights."""
_WAVES = 8
_LENGTHS_M = (20.0, 80.0)
"""Shortest and longest wave."""
SLOPE = 0.01
"""Default root mean square slope in each direction."""


@dataclass(frozen=True, slots=True)
class Terrain:
    """Heights of the ground on a square grid."""

    heights_m: FloatArray
    """Heights (H, W) at multiples of ``CELL_M``, from the south-west corner; rows go with y."""

    def slope(self, point: FloatArray) -> FloatArray:
        """Slope (2,) along x and y of the ground at ``point`` (2,)."""
        east, north = np.eye(2) * 0.5 * CELL_M
        return np.array([self._height(point + step) - self._height(point - step) for step in (east, north)]) / CELL_M

    def _height(self, point: FloatArray) -> float:
        height, width = self.heights_m.shape
        column, row = np.clip(point / CELL_M, 0.0, (width - 1.001, height - 1.001))
        j, i = int(column), int(row)
        across, up = column - j, row - i
        below, above = self.heights_m[i : i + 2, j : j + 2] @ (1.0 - across, across)
        return float(below + up * (above - below))


class YardKind(StrEnum):
    """Kinds of pieces in a yard."""

    WALL = "wall"
    GLASS = "glass"
    COLUMN = "column"
    CABINET = "cabinet"
    TRUNK = "trunk"
    BOLLARD = "bollard"
    HEDGE = "hedge"
    """A bush; hedges are rows of them."""
    FENCE = "fence"
    LOW_WALL = "low wall"
    CAR = "car"


ROUND = frozenset({YardKind.COLUMN, YardKind.TRUNK, YardKind.BOLLARD, YardKind.HEDGE})
"""Kinds of pieces that are discs."""


@dataclass(frozen=True, slots=True)
class YardPlan(FloorPlan):
    """What stands in a yard; its lanes are the ways, and it has no rooms."""

    terrain: Terrain


def draw_terrain(size_m: tuple[float, float], rng: np.random.Generator, slope: float = SLOPE) -> Terrain:
    """Draw hills for an area from west to east and from south to north.

    ``slope`` is the root mean square in each direction; most slopes are below twice this.
    """
    x = np.arange(0.0, size_m[0] + 2.0 * CELL_M, CELL_M)
    y = np.arange(0.0, size_m[1] + 2.0 * CELL_M, CELL_M)[:, None]
    heights = np.zeros((len(y), len(x)))
    for _ in range(_WAVES):
        number = 2.0 * np.pi / np.exp(rng.uniform(*np.log(_LENGTHS_M)))
        heading, phase = rng.uniform(0.0, 2.0 * np.pi, 2)
        # The slope of a wave has the same size for every length, so long hills are higher than short ones.
        amplitude = 2.0 * slope / (number * np.sqrt(_WAVES))
        heights += amplitude * np.sin(number * (x * np.cos(heading) + y * np.sin(heading)) + phase)
    return Terrain(frozen(heights))
