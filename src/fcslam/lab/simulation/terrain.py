"""Sloping ground of a yard. It tilts the robot and its scan plane, but poses stay those seen from above."""

from dataclasses import dataclass

import numpy as np

from fcslam.records import FloatArray, frozen

CELL_M = 1.0
"""Distance of neighbouring heights."""
_WAVES = 8
_LENGTHS_M = (20.0, 80.0)
"""Shortest and longest wave."""
SLOPE = 0.01
"""Default root mean square slope in each direction."""
BUMP_CELL_M = 0.5
"""Side of the squares of ground that may be a bump: a robot at 0.5 m/s crosses one in a second."""
_BUMP_RAD = 0.07
"""Standard deviation of the pitch and roll on a bump."""


@dataclass(frozen=True, slots=True)
class Terrain:
    """Heights of the ground on a square grid."""

    heights_m: FloatArray
    """Heights (H, W) at multiples of ``CELL_M``, from the south-west corner; rows go with y."""
    bumps: FloatArray | None = None
    """Tilt along x and y of a robot in each square of ``BUMP_CELL_M``, shape (H, W, 2), radians; mostly zero."""

    def slope(self, point: FloatArray) -> FloatArray:
        """Slope (2,) along x and y of a robot at ``point`` (2,); on a bump, it differs from that of the ground."""
        east, north = np.eye(2) * 0.5 * CELL_M
        slope = np.array([self._height(point + step) - self._height(point - step) for step in (east, north)]) / CELL_M
        if self.bumps is None:
            return slope
        column, row = np.clip(point / BUMP_CELL_M, 0, np.array(self.bumps.shape[1::-1]) - 1).astype(int)
        return np.asarray(slope + self.bumps[row, column])

    def _height(self, point: FloatArray) -> float:
        height, width = self.heights_m.shape
        column, row = np.clip(point / CELL_M, 0.0, (width - 1.001, height - 1.001))
        j, i = int(column), int(row)
        across, up = column - j, row - i
        below, above = self.heights_m[i : i + 2, j : j + 2] @ (1.0 - across, across)
        return float(below + up * (above - below))


def draw_terrain(
    size_m: tuple[float, float], rng: np.random.Generator, slope: float = SLOPE, bumps: float = 0.0
) -> Terrain:
    """Draw hills for an area from west to east and from south to north.

    Args:
        size_m: size of the area.
        rng: source of the hills and bumps.
        slope: root mean square slope in each direction; most slopes are below twice this.
        bumps: share of the ground that is a bump.
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
    return Terrain(frozen(heights), draw_bumps(size_m, rng, bumps))


def draw_bumps(size_m: tuple[float, float], rng: np.random.Generator, share: float) -> FloatArray | None:
    """Draw the bumps of an area, as in ``Terrain.bumps``: kerbs and holes that tilt a robot for one or two scans."""
    if not share:
        return None
    cells = int(size_m[1] / BUMP_CELL_M) + 1, int(size_m[0] / BUMP_CELL_M) + 1
    is_bump = rng.random(cells) < share
    return frozen(is_bump[..., None] * rng.normal(0.0, _BUMP_RAD, (*cells, 2)))
