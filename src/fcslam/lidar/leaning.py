"""The line in which a leaning laser sees the floor.

A laser that leans by some degrees sees the floor some metres away, in a straight line that moves with the robot. A map
takes it for a wall, and matches it to itself from scan to scan, as if the robot stood still. Nothing is seen beyond it,
whichever way the robot looks; so it shows as a line at which the ranges of many beams end.
"""

import math
from collections.abc import Iterable
from itertools import islice
from typing import Final

import numpy as np

from fcslam.geometry import se2
from fcslam.lidar.own_body import NOTHING_M, by_degree
from fcslam.lidar.straightness import scans_apart
from fcslam.records import FloatArray, LaserScan
from fcslam.sources.returns import FloorLine

FEWEST_PLACES, MOST_PLACES = 60, 400
HEADINGS, FEWEST_HEADINGS = 12, 8
"""Parts of the turn, and how many of them the robot must have looked to: each counts the same, as along a corridor a
wall stays where it is."""
HALF_DEG: Final = 35
"""Half of the sector that must see the line; a circle differs from a line by a fifth there."""
STEP_DEG: Final = 5
"""Between the directions that are tried."""
LEAST_RETURNS: Final = 0.3
"""Share of the scans that have a return in each degree of the sector."""
FARTHEST_SHARE: Final = 0.97
"""Share of the ranges of a degree up to its end."""
SAME: Final = 0.06
"""Largest deviation from the line, as a share of its distance: robots nod."""
LEAST_STRAIGHT, LEAST_AT, MOST_BEYOND = 0.9, 0.12, 0.02
"""Shares: of the degrees that end at the line, of the returns there, and of those farther than ``BEYOND`` of it. No
level laser of 26 recordings meets them, in any stretch of 60, 120 or 400 places."""
BEYOND: Final = 1.1
LEAST_M: Final = 1.0
"""What is nearer is the robot's body."""


def floor_line(scans: Iterable[LaserScan]) -> FloorLine | None:
    """The line in which a laser sees the floor; None if it does not, or the drive does not tell."""
    places = list(islice(scans_apart(scans), MOST_PLACES))
    headings = np.array([scan.T_odom_base[2] for scan in places])
    if len(places) < FEWEST_PLACES or not np.isfinite(headings).all():
        return None
    parts = np.floor(np.remainder(headings, 2.0 * np.pi) * (HEADINGS / (2.0 * np.pi))).astype(np.intp) % HEADINGS
    counts = np.bincount(parts, minlength=HEADINGS)
    if np.count_nonzero(counts) < FEWEST_HEADINGS:
        return None
    ranges_m = np.stack([by_degree(scan) for scan in places])
    weights = (1.0 / counts[parts])[:, None] * (ranges_m < NOTHING_M)
    ends_m = _quantiles(ranges_m, weights, FARTHEST_SHARE)
    is_seen = weights.sum(axis=0) > LEAST_RETURNS * np.count_nonzero(counts)
    found = []
    for middle in range(0, 360, STEP_DEG):
        offsets = np.arange(-HALF_DEG, HALF_DEG)
        offsets = offsets[is_seen[(middle + offsets) % 360]]
        if len(offsets) < HALF_DEG:
            continue
        sector, cosines = (middle + offsets) % 360, np.cos(np.radians(offsets + 0.5))
        distance_m = float(np.median(ends_m[sector] * cosines))
        on_line = np.abs(ends_m[sector] * cosines - distance_m) < SAME * distance_m
        if distance_m < LEAST_M or on_line.mean() < LEAST_STRAIGHT:
            continue
        away, weight = ranges_m[:, sector] * cosines / distance_m, weights[:, sector] / weights[:, sector].sum()
        at = float(weight[np.abs(away - 1.0) < SAME].sum())
        if at >= LEAST_AT and weight[away > BEYOND].sum() <= MOST_BEYOND:
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


def _quantiles(values: FloatArray, weights: FloatArray, share: float) -> FloatArray:
    """Of each column, the least value up to which its weights add up to ``share``, shape (columns,)."""
    order = np.argsort(values, axis=0)
    sums = np.take_along_axis(weights, order, axis=0).cumsum(axis=0)
    first = np.argmax(sums >= share * sums[-1], axis=0)
    return np.asarray(np.take_along_axis(values, order, axis=0)[first, np.arange(values.shape[1])])
