"""The line in which a leaning laser sees the floor.

A laser that leans by some degrees sees the floor some metres away, in a straight line that moves with the robot. A map
takes it for a wall, and matches it to itself from scan to scan, as if the robot stood still. Nothing is seen beyond it;
so it shows as a line at which the ranges of many beams end. The wall of a lane or of a round building shows as one,
too, but it comes nearer when the robot drives towards it.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import replace
from functools import partial
from itertools import islice
from typing import Final

import numpy as np

from fcslam.geometry import se2
from fcslam.lidar.facing import (
    AS_STATED,
    LEAST_AGREEMENT,
    SCANS_WATCHED,
    Contradiction,
    contradicted_facing,
    part_agreement,
)
from fcslam.lidar.own_body import MOST_PLACES, by_degree, scans_apart
from fcslam.lidar.scan import rays_of
from fcslam.records import FloatArray, LaserScan, frozen
from fcslam.sources.returns import FloorLine

FEWEST_PLACES: Final = SCANS_WATCHED
HALF_DEG: Final = 35
"""Half of the sector that must see the line; a circle differs from a line by a fifth there."""
LEAST_RETURNS: Final = 0.3
"""Share of the scans that have a return in each degree of the sector."""
SAME: Final = 0.06
"""Largest deviation from the line, as a share of its distance: robots nod."""
LEAST_STRAIGHT, MOST_BEYOND = 0.9, 0.02
"""Shares: of the degrees that end at the line, and of the returns farther than ``BEYOND`` of it."""
BEYOND: Final = 1.0 + 2.0 * SAME
LEAST_M: Final = 1.0
"""A nearer line belongs to the robot."""
FARTHEST_SHARE: Final = 1.0 - MOST_BEYOND
"""Share of the ranges of a degree up to its end."""
MOVING: Final = 0.3
"""Largest agreement of a line that moves with the robot; a wall keeps its place, also in a lane or a round building."""


def wrong_laser(scans: Sequence[LaserScan]) -> FloorLine | Contradiction | None:
    """What is wrong with how a laser is mounted, by the scans of ``watch_facing``."""
    return floor_line(scans) or contradicted_facing(scans)


def floor_line(scans: Sequence[LaserScan]) -> FloorLine | None:
    """The line in which a laser sees the floor; None if it does not, or the drive does not tell.

    With odometry of another unit every wall moves with the robot, so the other returns must fit the odometry.
    """
    line = _line_ahead(scans)
    if line is None or not part_agreement(scans, partial(_at_line, line)) < MOVING:
        return None
    if part_agreement(scans, line.left_out) > LEAST_AGREEMENT:
        return line
    found = contradicted_facing(map(line.left_out, scans))
    return line if found is not None and found.facing != AS_STATED else None


def _at_line(line: FloorLine, scan: LaserScan) -> LaserScan:
    heading_rad = line.heading_rad + scan.laser.T_base_laser[2]
    _, directions = rays_of(scan.laser)
    ahead = directions @ (math.cos(heading_rad), math.sin(heading_rad))
    away = scan.ranges_m * ahead / line.distance_m
    return replace(scan, ranges_m=frozen(np.where(np.abs(away - 1.0) < SAME, scan.ranges_m, np.nan), np.float32))


def _line_ahead(scans: Iterable[LaserScan]) -> FloorLine | None:
    places = list(islice(scans_apart(scans), MOST_PLACES))
    if len(places) < FEWEST_PLACES:
        return None
    ranges_m = np.stack([by_degree(scan) for scan in places])
    ranges_m[np.isinf(ranges_m)] = np.nan
    is_seen = np.isfinite(ranges_m).mean(axis=0) > LEAST_RETURNS
    ends_m = np.full(360, np.nan)
    ends_m[is_seen] = np.nanquantile(ranges_m[:, is_seen], FARTHEST_SHARE, axis=0)
    found = []
    for middle in range(360):
        offsets = np.arange(-HALF_DEG, HALF_DEG)
        offsets = offsets[is_seen[(middle + offsets) % 360]]
        if len(offsets) < HALF_DEG:
            continue
        sector, cosines = (middle + offsets) % 360, np.cos(np.radians(offsets + 0.5))
        distance_m = float(np.median(ends_m[sector] * cosines))
        on_line = np.abs(ends_m[sector] * cosines - distance_m) < SAME * distance_m
        if distance_m < LEAST_M or on_line.mean() < LEAST_STRAIGHT:
            continue
        away = ranges_m[:, sector] * cosines / distance_m
        away = away[np.isfinite(away)]
        at = float((np.abs(away - 1.0) < SAME).mean())
        if (away > BEYOND).mean() <= MOST_BEYOND:
            found.append((at, _line(ends_m[sector[on_line]], np.radians(sector[on_line] + 0.5))))
    if not found:
        return None
    line = max(found)[1]
    return line._replace(heading_rad=float(se2.wrap_angle(line.heading_rad - places[0].laser.T_base_laser[2])))


def _line(ranges_m: FloatArray, headings_rad: FloatArray) -> FloorLine:
    """The line through points, by least squares of ``(x cos(heading) + y sin(heading)) = 1 / range``."""
    design = np.stack((np.cos(headings_rad), np.sin(headings_rad)), axis=1)
    x, y = np.linalg.lstsq(design, 1.0 / ranges_m, rcond=None)[0].tolist()
    return FloorLine(1.0 / math.hypot(x, y), math.atan2(y, x))
