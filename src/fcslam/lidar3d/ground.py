"""Where the floor is around a robot with a 3D LiDAR, and what a 2D laser above it would see.

The floor is where wheels stand: it follows the robot over ramps. Up is the normal of most floors, so that a ramp does
not count. An IMU says which floors are level, and gives up where no floor is seen.
"""

from math import cos, radians
from typing import Final

import numpy as np

from fcslam.compiled import njit
from fcslam.geometry import se3
from fcslam.records import FloatArray, LaserModel, Ranges
from fcslam.sources.point_clouds import CloudBand

_SAME_FLOOR: Final = cos(radians(3.0))
"""Floors that lean by less against the vertical are level."""
_GRAVITY, _FORCE_SHARE = 9.81, 0.1
"""Specific force at rest, m/s^2 (some IMUs state multiples of it), and the largest share by which it may be wrong."""
_RATE: Final = 0.02
"""Least share of a new measurement in the vertical."""
_BAND: Final = CloudBand(low_m=0.2)
"""Heights above the floor of what a 2D laser sees."""
_CELL_M, _CELLS = 0.5, 64
"""Side of a cell of the heights of the floor, and cells along a side of their square."""
_STEP_M: Final = 0.12
"""Largest step of the floor between neighbouring cells."""


class Vertical:
    """The direction of up in ``odom``: that of most keyframes, as a robot may start on a ramp."""

    def __init__(self) -> None:
        self.up = np.array([0.0, 0.0, 1.0])
        self._found: list[tuple[FloatArray, int]] = []
        """Directions that differ, and how often each was measured."""
        self._stamp, self._position = np.nan, np.zeros(3)
        """Of the newest turn."""
        self._felt_s, self._impulse = 0.0, np.zeros(3)
        """Time since the newest keyframe, and the integral of the specific force over it."""
        self._velocity, self._velocity_before = np.full(3, np.nan), np.full(3, np.nan)
        """At the newest turn, and at the newest keyframe."""

    def feel(self, stamp: float, T_odom_base: FloatArray, force: FloatArray | None) -> None:
        """Take the next turn with the mean specific force (3,) in ``base`` since the one before; None without an
        IMU."""
        elapsed_s = stamp - self._stamp
        if elapsed_s > 0.0:
            self._velocity = (T_odom_base[:3] - self._position) / elapsed_s
            self._felt_s += elapsed_s
            self._impulse += elapsed_s * (np.nan if force is None else se3.rotation(T_odom_base) @ force)
        self._stamp, self._position = stamp, T_odom_base[:3]

    def take(self, floor: FloatArray | None) -> None:
        """The newest turn is a keyframe, which sees a floor with this normal (3,) in ``odom``, or none."""
        gravity = self._gravity()
        if floor is not None and (gravity is None or floor @ gravity > _SAME_FLOOR):
            self.add(floor)
        elif gravity is not None:
            self.add(gravity)

    def _gravity(self) -> FloatArray | None:
        """Direction of the specific force since the keyframe before, without the part that changed the velocity."""
        felt, changed = self._impulse / max(self._felt_s, 1e-9), self._velocity - self._velocity_before
        changed /= max(self._felt_s, 1e-9)
        self._felt_s, self._impulse, self._velocity_before = 0.0, np.zeros(3), self._velocity
        unit = 1.0 if np.linalg.norm(felt) > np.sqrt(_GRAVITY) else _GRAVITY
        gravity = unit * felt - changed
        strength = np.linalg.norm(gravity)
        return gravity / strength if abs(strength - _GRAVITY) < _FORCE_SHARE * _GRAVITY else None

    def add(self, direction: FloatArray) -> None:
        """Take a measured direction (3,): of a floor, or of gravity."""
        direction = direction / np.linalg.norm(direction)
        near = [float(direction @ mean) for mean, _ in self._found]
        if not near or max(near) < _SAME_FLOOR:
            self._found.append((direction, 1))
        else:
            k = int(np.argmax(near))
            mean, count = self._found[k][0], self._found[k][1] + 1
            mean = mean + max(_RATE, 1.0 / count) * (direction - mean)
            self._found[k] = mean / np.linalg.norm(mean), count
        self.up = max(self._found, key=lambda found: found[1])[0]


def levelled(T_odom_base: FloatArray, up: FloatArray, height_m: float) -> FloatArray:
    """``T_odom_ground`` (7,): its z axis is ``up``, its x axis has the heading of the base, which is ``height_m`` above
    its origin."""
    forward = se3.rotation(T_odom_base)[:, 0]
    x = forward - (forward @ up) * up
    x /= np.linalg.norm(x)
    matrix = np.eye(4)
    matrix[:3, 0], matrix[:3, 1], matrix[:3, 2] = x, np.cross(up, x), up
    matrix[:3, 3] = T_odom_base[:3] - height_m * up
    return se3.from_matrix(matrix)


def seen_by(laser: LaserModel, points: FloatArray, around: FloatArray) -> Ranges:
    """What a laser above the floor sees of ``points`` (N, 3) in a level frame on the floor, shape (beam_count,).

    0: nothing is measured. The points ``around`` (M, 3) show the floor.
    """
    heights = points[:, 2] - _floor_below(points, _floor_heights(around, _CELLS, _CELL_M, _STEP_M), _CELL_M)
    seen = points[(heights > _BAND.low_m) & (heights < _BAND.high_m)]
    distances = np.hypot(seen[:, 0], seen[:, 1])
    angles = np.arctan2(seen[:, 1], seen[:, 0])
    beams = np.rint((angles - laser.angle_min_rad) / laser.angle_increment_rad).astype(np.int64) % laser.beam_count
    nearest = np.full(laser.beam_count, np.inf)
    np.minimum.at(nearest, beams, distances)
    return np.where(np.isfinite(nearest), nearest, 0.0).astype(np.float32)


@njit
def _floor_heights(points, cells, cell_m, step_m):  # type: ignore[no-untyped-def]
    """Height of the floor in the cells around the origin, shape (cells, cells).

    It spreads from the origin to the lowest points of cells that are no higher step away; other cells have the height
    of the neighbour that was reached before.
    """
    half = cells // 2
    lowest = np.full((cells, cells), np.inf)
    for p in range(len(points)):
        i, j = int(np.floor(points[p, 0] / cell_m)) + half, int(np.floor(points[p, 1] / cell_m)) + half
        if 0 <= i < cells and 0 <= j < cells and points[p, 2] < lowest[i, j]:
            lowest[i, j] = points[p, 2]
    floor = np.full((cells, cells), np.inf)
    queue = np.empty((cells * cells, 2), np.int64)
    first, last = 0, 0
    for i in range(half - 1, half + 1):
        for j in range(half - 1, half + 1):
            floor[i, j] = lowest[i, j] if abs(lowest[i, j]) < step_m else 0.0
            queue[last, 0], queue[last, 1] = i, j
            last += 1
    while first < last:
        i, j = queue[first]
        first += 1
        for k in range(4):
            u, v = i + (k == 0) - (k == 1), j + (k == 2) - (k == 3)
            if 0 <= u < cells and 0 <= v < cells and floor[u, v] == np.inf:
                floor[u, v] = lowest[u, v] if abs(lowest[u, v] - floor[i, j]) < step_m else floor[i, j]
                queue[last, 0], queue[last, 1] = u, v
                last += 1
    return floor


@njit
def _floor_below(points, floor, cell_m):  # type: ignore[no-untyped-def]
    """Height of the floor at points (N, 3), shape (N,); beyond the cells that of the nearest one."""
    cells = len(floor)
    half = cells // 2
    heights = np.empty(len(points))
    for p in range(len(points)):
        i = min(max(int(np.floor(points[p, 0] / cell_m)) + half, 0), cells - 1)
        j = min(max(int(np.floor(points[p, 1] / cell_m)) + half, 0), cells - 1)
        heights[p] = floor[i, j]
    return heights
