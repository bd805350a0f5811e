"""Occupancy grid by ray casting: each beam passes the cells up to its end and hits the last one.

Over several periods the grid shows the newest state: where a period clearly contradicts what earlier ones counted in a
cell, their counts are dropped. A cell that a period did not observe stays as it was.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from fcslam.compiled import njit
from fcslam.config import Settings
from fcslam.lidar.scan import beam_times, ray_at, rays_of
from fcslam.records import FloatArray, LaserModel, Ranges, Sweep
from fcslam.runs.map_files import Cells

Counts = NDArray[np.uint32]

CLEAR_RATIO = 0.05
"""Ratio of hits to passes up to which a period calls a cell free that was occupied. It is far below ``occupied_ratio``:
beams that graze a wall hit its cells seldom, too."""
FARTHEST_M = 1e7
"""Poses farther from the origin are refused: floats no longer resolve cells there."""


class OccupancyConfig(Settings):
    """The occupancy grid."""

    resolution_m: float = Field(default=0.05, ge=0.001, le=10.0, description="side of a cell [m]")
    usable_range_m: float = Field(
        default=30.0, gt=0, le=1000.0, description="longer beams clear cells up to this range and hit nothing [m]"
    )
    minimum_passes: int = Field(default=2, ge=1, description="least number of beams through a known cell")
    occupied_ratio: float = Field(
        default=0.15, gt=0, lt=1, description="ratio of hits to passes above which a cell is occupied"
    )
    contradicting_scans: int = Field(
        default=3,
        ge=1,
        description="least number of scans of a later period that change a cell from occupied to free or back",
    )
    maximum_cells: int = Field(
        default=64_000_000,
        ge=1024,
        description="largest number of cells; a larger grid gets cells twice as wide, until it fits",
    )


@dataclass(frozen=True, slots=True)
class OccupancyGrid:
    """Beam counts per cell; row 0 is the lowest y, column 0 the lowest x.

    Cell edges lie on multiples of the resolution, which is that of the configuration, doubled as often as the limit
    on cells asked for.
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
    """Scans of one laser with the same beams at the same times, stacked."""

    ranges_m: Ranges  # (N, beam_count)
    origins: FloatArray  # (beam_count, 2) in base, as if all were measured at the stamp
    directions: FloatArray  # (beam_count, 2)
    times_s: FloatArray  # (beam_count,)
    T_map_base: FloatArray  # (N, 3)
    velocity: FloatArray  # (N, 3)
    acceleration: FloatArray  # (N, 3)
    max_range_m: float


_AT_ONCE = Sweep(0.0, 0.0)
"""A scan whose beams were all measured at the stamp."""


class _Layout(NamedTuple):
    """Where the grid lies and how fine it is."""

    resolution_m: float
    column: int  # of the lower left cell, counted from the origin of map
    row: int
    width: int
    height: int


class _Counts(NamedTuple):
    """Of one period, by cell."""

    hits: Counts
    passes: Counts
    scans: Counts
    """Scans with a beam through the cell; empty if they are not counted."""
    newest: Counts
    """The last of these scans, counted from 1; empty if scans are not counted."""


def cast(keyscans: Sequence[Casting], config: OccupancyConfig) -> OccupancyGrid:
    """Count hits and passes of all beams. Invalid ranges (0, not finite, at the maximum) add nothing.

    The grid spans all hits and all lasers; beams without a hit in usable range clear cells inside of it only.

    Args:
        keyscans: the scans.
        config: resolution, usable range and size.

    Returns:
        Counts, shape (H, W), in ``map``.

    Raises:
        ValueError: the number of ranges is not that of the beams, or a pose is not finite or too far away.
    """
    (grid,) = cast_periods([keyscans], config)
    return grid


def cast_periods(periods: Sequence[Sequence[Casting]], config: OccupancyConfig) -> Iterator[OccupancyGrid]:
    """The grid after each period, from the oldest to the newest; all have one size.

    A period changes an occupied cell to free if at least ``contradicting_scans`` scans look through the cell and at
    most ``CLEAR_RATIO`` of their beams end there. It changes a free cell to occupied if as many beams of as many scans
    end there, and enough to call the cell occupied. The counts of earlier periods are then dropped, else added.

    Args:
        periods: scans of each period, as for ``cast``.
        config: as for ``cast``.

    Yields:
        Counts, shape (H, W), in ``map``; the next step changes them.

    Raises:
        ValueError: as ``cast``.
    """
    groups = [_by_laser(keyscans) for keyscans in periods]
    layout = _layout([beams for period in groups for beams in period], config)
    shape, side = (layout.height, layout.width), layout.resolution_m
    hits, passes = np.zeros(shape, np.uint32), np.zeros(shape, np.uint32)
    uncounted = np.zeros((0, 0), np.uint32)
    for number, period in enumerate(groups):
        if number == 0:
            _cast_all(period, layout, config, _Counts(hits, passes, uncounted, uncounted))
        else:
            counts = _Counts(*(np.zeros(shape, np.uint32) for _ in range(4)))
            _cast_all(period, layout, config, counts)
            _supersede(
                hits, passes, counts, config.contradicting_scans, CLEAR_RATIO, config.occupied_ratio,
                config.minimum_passes,
            )  # fmt: skip
        shown = hits.view(), passes.view()
        for view in shown:
            view.setflags(write=False)
        yield OccupancyGrid(*shown, side, (layout.column * side, layout.row * side))


def _by_laser(keyscans: Sequence[Casting]) -> list[_Beams]:
    by_beams: dict[tuple[LaserModel, Sweep], list[Casting]] = {}
    for scan in keyscans:
        times = _AT_ONCE if scan.sweep is None else Sweep(scan.sweep.first_s, scan.sweep.last_s)
        by_beams.setdefault((scan.laser, times), []).append(scan)
    return [_stacked(scans, laser, times) for (laser, times), scans in by_beams.items()]


def _cast_all(groups: list[_Beams], layout: _Layout, config: OccupancyConfig, counts: _Counts) -> None:
    first = 1
    for beams in groups:
        _cast(beams, layout, config.usable_range_m, counts, first)
        first += len(beams.ranges_m)


def classify(grid: OccupancyGrid, config: OccupancyConfig) -> Cells:
    """``Occupancy`` of every cell, shape (H, W), by Karto's rule: enough passes make it known, enough hits occupied."""
    cells: Cells = _classify(grid.hits, grid.passes, config.minimum_passes, config.occupied_ratio)
    cells.setflags(write=False)
    return cells


def _stacked(keyscans: list[Casting], laser: LaserModel, times: Sweep) -> _Beams:
    for ranges_m, _, T_map_base, _ in keyscans:
        if np.shape(ranges_m) != (laser.beam_count,):
            raise ValueError(f"ranges of shape {np.shape(ranges_m)} from a laser of {laser.beam_count} beams")
        if np.shape(T_map_base) != (3,):
            raise ValueError(f"a pose of shape {np.shape(T_map_base)}, expected (3,)")
    ranges_m = np.array([scan.ranges_m for scan in keyscans], np.float32)
    poses = np.array([scan.T_map_base for scan in keyscans])
    if not (np.abs(poses) < FARTHEST_M).all():  # false for NaN
        raise ValueError(f"poses must be finite and within {FARTHEST_M:g} m of the origin")
    sweeps = [scan.sweep or _AT_ONCE for scan in keyscans]
    return _Beams(
        ranges_m, *rays_of(laser), beam_times(laser, times), poses, np.array([sweep.velocity for sweep in sweeps]),
        np.array([sweep.acceleration for sweep in sweeps]), laser.max_range_m,
    )  # fmt: skip


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


@njit
def _bounds(beams, usable):  # type: ignore[no-untyped-def]
    """Lowest and highest (x, y) of the lasers and of all returns in usable range."""
    reach = min(usable, beams.max_range_m)
    low, high = np.full(2, np.inf), np.full(2, -np.inf)
    for k in range(len(beams.ranges_m)):
        for i in range(len(beams.times_s)):
            x, y, dx, dy = _ray(beams, k, i)
            r = beams.ranges_m[k, i]
            reached = r if r > 0.0 and r < reach else 0.0  # 0 for NaN
            low[0], high[0] = min(low[0], x, x + reached * dx), max(high[0], x, x + reached * dx)
            low[1], high[1] = min(low[1], y, y + reached * dy), max(high[1], y, y + reached * dy)
    return low, high


@njit(allocates=False)
def _ray(beams, k, i):  # type: ignore[no-untyped-def]
    """Origin and direction of beam i of scan k in ``map``, as four numbers."""
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
            if _traverse(x0, y0, x1, y1, counts, np.uint32(first + k)) and r < usable:
                counts.hits[int(np.floor(y1)), int(np.floor(x1))] += np.uint32(1)


@njit(allocates=False)
def _traverse(x0, y0, x1, y1, counts, scan):  # type: ignore[no-untyped-def]
    """Count a pass for each cell of a beam, including the first and the last; returns whether the last is in the grid.

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
def _supersede(hits, passes, period, scans, clear_ratio, occupied_ratio, minimum_passes):  # type: ignore[no-untyped-def]
    """Add the counts of a newer period; where it clearly contradicts, they replace the older ones."""
    for row in range(hits.shape[0]):
        for column in range(hits.shape[1]):
            n, h = period.passes[row, column], period.hits[row, column]
            if n == 0:
                continue
            if passes[row, column] >= minimum_passes and period.scans[row, column] >= scans:
                was_occupied = hits[row, column] > occupied_ratio * passes[row, column]
                cleared = was_occupied and h <= clear_ratio * n
                filled = not was_occupied and h >= scans and h > occupied_ratio * n
                if cleared or filled:
                    hits[row, column] = passes[row, column] = 0
            hits[row, column] += h
            passes[row, column] += n


@njit
def _classify(hits, passes, minimum_passes, occupied_ratio):  # type: ignore[no-untyped-def]
    cells = np.zeros(hits.shape, np.uint8)
    for row in range(hits.shape[0]):
        for column in range(hits.shape[1]):
            n = passes[row, column]
            if n >= minimum_passes:
                occupied = hits[row, column] > occupied_ratio * n
                cells[row, column] = 2 if occupied else 1
    return cells
