"""Occupancy grid by ray casting: each beam passes the cells up to its end and hits the last one.

Over several periods the grid shows the newest state: where a period clearly contradicts what earlier ones counted in a
cell, their counts are dropped. A cell that a period did not observe stays as it was.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import accumulate
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from fcslam.compiled import njit
from fcslam.config import Settings
from fcslam.geometry.beams import is_full_turn
from fcslam.lidar.scan import beam_times, ray_at, rays_of
from fcslam.maps.occupancy_map import FARTHEST_M, Cells, Occupancy, OccupancyMap
from fcslam.records import FloatArray, LaserModel, Ranges, Sweep

Counts = NDArray[np.uint32]

MINIMUM_PASSES = 2
"""Least number of beams through a known cell."""
OCCUPIED_RATIO = 0.15
"""Ratio of hits to passes above which a cell is occupied."""
CLEAR_RATIO = 0.05
"""Ratio of hits to passes up to which a period calls a cell free that was occupied. It is far below ``OCCUPIED_RATIO``:
beams that graze a wall hit its cells seldom, too."""
CLEARANCE_CELLS = 2.0
"""A beam without return ends this far before the line between the returns beside it, which may be one surface."""
SETTLED_PASSES = int(np.iinfo(np.uint32).max) // 2
"""Beams that each known cell of a finished map counts for: newer scans change it only if they contradict it."""


class OccupancyConfig(Settings):
    """The occupancy grid."""

    resolution_m: float = Field(default=0.05, ge=0.001, le=10.0, description="side of a cell [m]")
    usable_range_m: float = Field(
        default=30.0,
        gt=0,
        le=1000.0,
        description="longer beams, and those without return, clear cells up to this range at most and hit nothing [m]",
    )
    contradicting_scans: int = Field(
        default=3,
        ge=1,
        description="least number of scans of a later period that change a cell from occupied to free or back",
    )
    robot_radius_m: float = Field(
        default=0.35,
        ge=0,
        le=5,
        description="radius of a robot of the fleet: points on it, where other robots look through, are not "
        "drawn, and a live robot does not match its scans by them [m]; 0: all count",
    )
    maximum_cells: int = Field(
        default=64_000_000,
        ge=1024,
        description="largest number of cells; a larger grid gets cells twice as wide, until it fits",
    )


@dataclass(frozen=True, slots=True)
class OccupancyGrid:
    """Beam counts per cell; row 0 is the lowest y, column 0 the lowest x.

    Cell edges lie on multiples of the resolution, doubled as often as the limit on cells asked for.
    """

    hits: Counts
    """Beams that end in the cell, shape (H, W)."""
    passes: Counts
    """Beams that cross the cell or end in it, shape (H, W)."""
    resolution_m: float
    origin_xy: tuple[float, float]
    """Lower left corner of cell (0, 0) in ``map``."""


class Casting(NamedTuple):
    """A scan and its pose."""

    ranges_m: Ranges
    """Shape (beam_count,), metres."""
    laser: LaserModel
    T_map_base: FloatArray
    """At the stamp, shape (3,), metres and radians."""
    sweep: Sweep | None = None


class _Beams(NamedTuple):
    ranges_m: Ranges  # (N, beam_count)
    open_m: Ranges  # (N, beam_count): how far beams without return clear; 0 for others
    origins: FloatArray  # (beam_count, 2) in base, as if all were measured at the stamp
    directions: FloatArray  # (beam_count, 2)
    times_s: FloatArray  # (beam_count,)
    T_map_base: FloatArray  # (N, 3)
    velocity: FloatArray  # (N, 3)
    acceleration: FloatArray  # (N, 3)
    max_range_m: float


_UNCOUNTED = np.zeros((0, 0), np.uint32)
_NOTHING = np.zeros((0, 0), np.bool_)
_AT_ONCE = Sweep(0.0, 0.0)
"""A scan whose beams were all measured at the stamp."""


class _Layout(NamedTuple):
    resolution_m: float
    column: int  # of the lower left cell, counted from the origin of map
    row: int
    width: int
    height: int


class _Counts(NamedTuple):
    hits: Counts
    passes: Counts
    scans: Counts
    """Scans with a beam through the cell; empty if they are not counted."""
    newest: Counts
    """The last of these scans, counted from 1; empty if scans are not counted."""


def cast(keyscans: Sequence[Casting], config: OccupancyConfig) -> OccupancyGrid:
    """Count hits and passes of all beams. Invalid ranges (0, NaN, at the maximum) add nothing.

    The grid spans all hits, all lasers and what beams without return clear; longer beams clear cells inside of it only.
    A beam without return (inf) may have met a surface that is black, glass or grazed. So it clears no farther than the
    nearer of the two returns beside it, and no farther than the line between them. Where they are half a turn or more
    apart, as in a hall, no line is between them: the beam clears as far as the scan has a return. It ends at cells that
    remain occupied.
    """
    (grid,) = cast_periods([keyscans], config)
    return grid


def cast_periods(periods: Sequence[Sequence[Casting]], config: OccupancyConfig) -> Iterator[OccupancyGrid]:
    """The grid after each period, from the oldest to the newest; all have one size. The next step changes their counts.

    A period changes an occupied cell to free if at least ``contradicting_scans`` scans look through the cell and at
    most ``CLEAR_RATIO`` of their beams end there. It changes a free cell to occupied if as many beams of as many scans
    end there, and enough to call the cell occupied. The counts of earlier periods are then dropped, else added.
    """
    groups = [_by_laser(keyscans, config) for keyscans in periods]
    layout = _layout([beams for period in groups for beams in period], config)
    side, first = layout.resolution_m, _counts(layout)
    hits, passes = first.hits, first.passes
    for number, period in enumerate(groups):
        if number == 0:
            _cast_all(period, layout, config, first)
        else:
            counts = _counts(layout, by_scan=True)
            _cast_all(period, layout, config, counts)
            _supersede(hits, passes, counts, config.contradicting_scans)
        shown = hits.view(), passes.view()
        for view in shown:
            view.setflags(write=False)
        yield OccupancyGrid(*shown, side, (layout.column * side, layout.row * side))


def draw_over(base: OccupancyMap, scans: Sequence[Casting], config: OccupancyConfig) -> OccupancyMap:
    """A finished map with newer scans drawn into it, as ``cast_periods`` draws a period after another one.

    Scans decide the cells that the map does not know. They change a known cell only if at least ``contradicting_scans``
    of them contradict it. The cells of the map keep their side.
    """
    side = base.resolution_m
    column, row = (round(value / side) for value in base.origin_xy)
    # Cell edges of other programs' maps need not lie on multiples of the resolution.
    off_x, off_y = base.origin_xy[0] - column * side, base.origin_xy[1] - row * side
    shift = np.array((off_x, off_y, 0.0))
    groups = _by_laser([scan._replace(T_map_base=scan.T_map_base - shift) for scan in scans], config)
    if not groups:
        return base
    drawn = _layout(groups, config.model_copy(update={"resolution_m": side}))
    if drawn.resolution_m != side:  # over the limit on cells
        return base
    height, width = base.cells.shape
    left, bottom = min(column, drawn.column), min(row, drawn.row)
    right, top = max(column + width, drawn.column + drawn.width), max(row + height, drawn.row + drawn.height)
    layout = _Layout(side, left, bottom, right - left, top - bottom)
    counts = _counts(layout, by_scan=True)
    hits, passes = np.zeros((2, layout.height, layout.width), np.uint32)
    inside = slice(row - bottom, row - bottom + height), slice(column - left, column - left + width)
    passes[inside] = np.where(base.cells != Occupancy.UNKNOWN, SETTLED_PASSES, 0)
    hits[inside] = np.where(base.cells == Occupancy.OCCUPIED, SETTLED_PASSES, 0)
    _cast_all(groups, layout, config, counts)
    _supersede(hits, passes, counts, config.contradicting_scans)
    cells = _classify(hits, passes)
    return OccupancyMap(cells, side, (left * side + off_x, bottom * side + off_y), base.floor)


def _by_laser(keyscans: Sequence[Casting], config: OccupancyConfig) -> list[_Beams]:
    by_beams: dict[tuple[LaserModel, Sweep], list[Casting]] = {}
    for scan in keyscans:
        times = _AT_ONCE if scan.sweep is None else Sweep(scan.sweep.first_s, scan.sweep.last_s)
        by_beams.setdefault((scan.laser, times), []).append(scan)
    return [_stacked(scans, laser, times, config.usable_range_m) for (laser, times), scans in by_beams.items()]


def _cast_all(groups: list[_Beams], layout: _Layout, config: OccupancyConfig, counts: _Counts) -> None:
    numbered = list(zip(groups, accumulate((len(beams.ranges_m) for beams in groups), initial=1), strict=False))
    for beams, first in numbered:
        _cast(beams, layout, config.usable_range_m, counts, first)
    if not any(beams.open_m.any() for beams in groups):
        return
    # All beams without return together decide which cells stay occupied although such beams pass.
    trial = counts._replace(passes=counts.passes.copy(), scans=_UNCOUNTED, newest=_UNCOUNTED)
    occupied = np.zeros(counts.hits.shape, np.bool_)
    for beams, first in numbered:
        _clear(beams, layout, trial, first, occupied)
    occupied = counts.hits > OCCUPIED_RATIO * trial.passes
    for beams, first in numbered:
        _clear(beams, layout, counts, first, occupied)


def classify(grid: OccupancyGrid) -> Cells:
    """``Occupancy`` of every cell, shape (H, W), by Karto's rule: enough passes make it known, enough hits occupied."""
    cells: Cells = _classify(grid.hits, grid.passes)
    cells.setflags(write=False)
    return cells


def _stacked(keyscans: list[Casting], laser: LaserModel, times: Sweep, longest_m: float) -> _Beams:
    ranges_m = np.array([scan.ranges_m for scan in keyscans], np.float32)
    poses = np.array([scan.T_map_base for scan in keyscans])
    if not (np.abs(poses) < FARTHEST_M).all():  # false for NaN
        raise ValueError(f"poses must be finite and within {FARTHEST_M:g} m of the origin")
    sweeps = [scan.sweep or _AT_ONCE for scan in keyscans]
    step_rad = abs(laser.beams.angle_increment_rad)
    return _Beams(
        ranges_m,
        _open_ranges(ranges_m, laser.max_range_m, step_rad, is_full_turn(laser.beams), longest_m),
        *rays_of(laser),
        beam_times(laser, times),
        poses,
        np.array([sweep.velocity for sweep in sweeps]),
        np.array([sweep.acceleration for sweep in sweeps]),
        laser.max_range_m,
    )


def _layout(groups: list[_Beams], config: OccupancyConfig) -> _Layout:
    if not groups:
        return _Layout(config.resolution_m, 0, 0, 1, 1)
    boxes = [_bounds(beams, config.usable_range_m) for beams in groups]
    low, high = np.min([box[0] for box in boxes], axis=0), np.max([box[1] for box in boxes], axis=0)
    resolution_m = config.resolution_m
    while True:
        # One cell to spare on each side: rounding may differ between the bounds and the casting.
        column, row = (math.floor(value / resolution_m) - 1 for value in low)
        width = math.floor(high[0] / resolution_m) + 2 - column
        height = math.floor(high[1] / resolution_m) + 2 - row
        if width * height <= config.maximum_cells:
            return _Layout(resolution_m, column, row, width, height)
        resolution_m *= 2.0


def _counts(layout: _Layout, by_scan: bool = False) -> _Counts:
    shape = layout.height, layout.width
    hits, passes = np.zeros(shape, np.uint32), np.zeros(shape, np.uint32)
    scans, newest = (np.zeros(shape if by_scan else (0, 0), np.uint32) for _ in range(2))
    return _Counts(hits, passes, scans, newest)


@njit
def _open_ranges(ranges_m, max_range_m, step_rad, is_turn, longest_m):  # type: ignore[no-untyped-def]
    """How far beams without return (inf) clear, shape (N, beam_count), metres; 0 for the others."""
    count = ranges_m.shape[1]
    found = np.zeros(ranges_m.shape, np.float32)
    for k in range(len(ranges_m)):
        returns = np.flatnonzero((ranges_m[k] > 0.0) & (ranges_m[k] < max_range_m))
        farthest = ranges_m[k][returns].max() if len(returns) else 0.0
        # The first beams and the last are neighbours if the laser looks all around.
        for n in range(len(returns) if is_turn else len(returns) - 1):
            first, last = returns[n], returns[(n + 1) % len(returns)]
            between = (last - first - 1) % count + 1
            a, b, angle = ranges_m[k, first], ranges_m[k, last], between * step_rad
            for i in range(1, between):
                beam = (first + i) % count
                if ranges_m[k, beam] != np.inf:
                    continue
                reach = farthest
                if angle < np.pi:
                    part = i * step_rad
                    line = a * b * np.sin(angle) / (a * np.sin(part) + b * np.sin(angle - part))
                    reach = min(a, b, line)
                found[k, beam] = min(reach, longest_m)
    return found


@njit
def _bounds(beams, usable):  # type: ignore[no-untyped-def]
    reach = min(usable, beams.max_range_m)
    low, high = np.full(2, np.inf), np.full(2, -np.inf)
    for k in range(len(beams.ranges_m)):
        for i in range(len(beams.times_s)):
            x, y, dx, dy = _ray(beams, k, i)
            r = beams.ranges_m[k, i]
            reached = r if r > 0.0 and r < reach else 0.0  # 0 for NaN
            reached = max(reached, beams.open_m[k, i])
            low[0], high[0] = min(low[0], x, x + reached * dx), max(high[0], x, x + reached * dx)
            low[1], high[1] = min(low[1], y, y + reached * dy), max(high[1], y, y + reached * dy)
    return low, high


@njit(allocates=False)
def _ray(beams, k, i):  # type: ignore[no-untyped-def]
    ox, oy, dx, dy = ray_at(
        beams.origins[i], beams.directions[i], beams.times_s[i], beams.velocity[k], beams.acceleration[k]
    )
    pose = beams.T_map_base[k]
    cos, sin = np.cos(pose[2]), np.sin(pose[2])
    return pose[0] + cos * ox - sin * oy, pose[1] + sin * ox + cos * oy, cos * dx - sin * dy, sin * dx + cos * dy


@njit(allocates=False)
def _cast(beams, layout, usable, counts, first):  # type: ignore[no-untyped-def]
    for k in range(len(beams.ranges_m)):
        for i in range(len(beams.times_s)):
            r = beams.ranges_m[k, i]
            if not (r > 0.0 and r < beams.max_range_m):  # true for NaN
                continue
            x, y, dx, dy = _ray(beams, k, i)
            x0, y0 = x / layout.resolution_m - layout.column, y / layout.resolution_m - layout.row
            length = min(r, usable) / layout.resolution_m
            x1, y1 = x0 + length * dx, y0 + length * dy
            if _traverse(x0, y0, x1, y1, counts, np.uint32(first + k), _NOTHING) and r < usable:
                column, row = int(np.floor(x1)), int(np.floor(y1))
                counts.hits[row, column] += np.uint32(1)


@njit(allocates=False)
def _clear(beams, layout, counts, first, occupied):  # type: ignore[no-untyped-def]
    for k in range(len(beams.ranges_m)):
        for i in range(len(beams.times_s)):
            length = beams.open_m[k, i] / layout.resolution_m - CLEARANCE_CELLS
            if length > 0.0:
                x, y, dx, dy = _ray(beams, k, i)
                x0, y0 = x / layout.resolution_m - layout.column, y / layout.resolution_m - layout.row
                _traverse(x0, y0, x0 + length * dx, y0 + length * dy, counts, np.uint32(first + k), occupied)


@njit(allocates=False)
def _traverse(x0, y0, x1, y1, counts, scan, occupied):  # type: ignore[no-untyped-def]
    """Count a pass for each cell of a beam, including the first and the last; returns whether the last is in the grid.

    A beam without return stops before cells that are ``occupied``; that of a return has an empty ``occupied``.
    Coordinates are in cells. Amanatides and Woo, "A fast voxel traversal algorithm for ray tracing", 1987.
    """
    height, width = counts.passes.shape
    counts_scans = counts.scans.size > 0
    column, row = int(np.floor(x0)), int(np.floor(y0))
    last_column, last_row = int(np.floor(x1)), int(np.floor(y1))
    right, up = x1 > x0, y1 > y0
    step_x, step_y = 1 if right else -1, 1 if up else -1
    per_x = 1.0 / (x1 - x0) if x1 != x0 else 0.0
    per_y = 1.0 / (y1 - y0) if y1 != y0 else 0.0
    edge_x, edge_y = column + int(right) - x0, row + int(up) - y0
    while 0 <= column < width and 0 <= row < height:
        if occupied.size > 0 and occupied[row, column]:
            return False
        counts.passes[row, column] += np.uint32(1)
        if counts_scans and counts.newest[row, column] != scan:
            counts.newest[row, column] = scan
            counts.scans[row, column] += np.uint32(1)
        if column == last_column and row == last_row:
            return True
        if row == last_row or (column != last_column and edge_x * per_x < edge_y * per_y):
            column += step_x
            edge_x += step_x
        else:
            row += step_y
            edge_y += step_y
    return False


@njit(allocates=False)
def _supersede(hits, passes, period, scans):  # type: ignore[no-untyped-def]
    """Add the counts of a newer period; where it clearly contradicts, they replace the older ones."""
    for row in range(hits.shape[0]):
        for column in range(hits.shape[1]):
            n, h = period.passes[row, column], period.hits[row, column]
            if n == 0:
                continue
            if passes[row, column] >= MINIMUM_PASSES and period.scans[row, column] >= scans:
                was_occupied = hits[row, column] > OCCUPIED_RATIO * passes[row, column]
                cleared = was_occupied and h <= CLEAR_RATIO * n
                filled = not was_occupied and h >= scans and h > OCCUPIED_RATIO * n
                if cleared or filled:
                    hits[row, column] = passes[row, column] = 0
            hits[row, column] += h
            passes[row, column] += n


@njit
def _classify(hits, passes):  # type: ignore[no-untyped-def]
    cells = np.zeros(hits.shape, np.uint8)
    for row in range(hits.shape[0]):
        for column in range(hits.shape[1]):
            n = passes[row, column]
            if n >= MINIMUM_PASSES:
                occupied = hits[row, column] > OCCUPIED_RATIO * n
                cells[row, column] = 2 if occupied else 1
    return cells
