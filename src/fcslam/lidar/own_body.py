"""The parts of a robot that its own laser sees: beams that never change, and what is left out.

Sectors are headings in ``base``, in degrees, counter-clockwise from the first to the second; 360 or more of them are
the whole turn. All of their beams are left out: what stands near the laser hides the rest. Of a polygon in ``base``,
only the returns within it are left out.
"""

import json
import math
from collections.abc import Iterable, Iterator, Sequence
from functools import lru_cache
from itertools import islice, pairwise
from typing import Annotated, Final

import numpy as np
from numpy.typing import NDArray
from pydantic import AfterValidator, BeforeValidator, Field

from fcslam.geometry import se2
from fcslam.lidar import calibration
from fcslam.records import FloatArray, LaserModel, LaserScan
from fcslam.sources.point_clouds import LARGEST_BODY_M

Heading = Annotated[float, Field(ge=-360.0, le=360.0)]
Sectors = tuple[tuple[Heading, Heading], ...]
Metres = Annotated[float, Field(ge=-20.0, le=20.0)]
LEAST_AREA_M2: Final = 1e-4
"""Smallest body."""
HOW_TO_GIVE: Final = "give corners [[x, y], ...] in the order of the outline"


def _as_list(corners: object) -> object:
    """Nav2 has its footprint as a text."""
    try:
        return json.loads(corners) if isinstance(corners, str) else corners
    except ValueError as error:
        raise ValueError(f"not a polygon: {HOW_TO_GIVE}") from error


def _is_polygon(corners: tuple[tuple[float, float], ...]) -> tuple[tuple[float, float], ...]:
    twice_area = sum(x1 * y2 - x2 * y1 for (x1, y1), (x2, y2) in _sides(corners))
    if corners and abs(twice_area) < 2.0 * LEAST_AREA_M2:  # also of fewer than three corners
        raise ValueError(f"not a polygon, because it has no area: {HOW_TO_GIVE}")
    return corners


def _sides(corners: Sequence[tuple[float, float]]) -> Iterator[tuple[tuple[float, float], tuple[float, float]]]:
    return pairwise((*corners, *corners[:1]))


Polygon = Annotated[
    tuple[tuple[Metres, Metres], ...], Field(max_length=100), BeforeValidator(_as_list), AfterValidator(_is_polygon)
]
"""Corners in the order of the outline; empty: none."""

LEAST_MOVE_M, LEAST_TURN_RAD = 2.0 * calibration.LEAST_MOVE_M, 2.0 * calibration.LEAST_TURN_RAD
"""The robot has moved or turned by so much between two scans that are compared."""
FEWEST_PLACES = calibration.FEWEST_MOTIONS
MOST_PLACES = 10 * FEWEST_PLACES
SAME_M, STEADY = 0.05, 0.95
"""Largest deviation of a return of the robot from its usual range, and share of the places at which it has it."""
MARGIN_DEG = 1
LARGEST_GAP_DEG = 3 * MARGIN_DEG
"""By how much sectors are wider than what was seen; sectors with a smaller gap are one."""
SHARPEST: Final = 0.8
"""Length of the mean heading above which a drive does not turn enough: along a corridor, walls stay as they are."""


@lru_cache(maxsize=256)  # the beams of some scanners vary from scan to scan
def is_in_sectors(laser: LaserModel, sectors: Sectors) -> NDArray[np.bool_]:
    """Which beams of a laser look into the sectors, shape (beam_count,)."""
    found = look_into_sectors(_headings_deg(laser), sectors)
    found.setflags(write=False)
    return found


def look_into_sectors(headings_deg: FloatArray, sectors: Sectors) -> NDArray[np.bool_]:
    """Which headings (N,) are in the sectors, shape (N,)."""
    found = np.zeros(len(headings_deg), np.bool_)
    for first_deg, last_deg in sectors:
        width_deg = last_deg - first_deg if last_deg - first_deg >= 360.0 else np.remainder(last_deg - first_deg, 360.0)
        found |= np.remainder(headings_deg - first_deg, 360.0) <= width_deg
    return found


def is_in_polygon(points: FloatArray, corners: Polygon) -> NDArray[np.bool_]:
    """Which points (N, 2) lie within a polygon, shape (N,)."""
    found = np.zeros(len(points), np.bool_)
    x, y = points.T
    for (x1, y1), (x2, y2) in _sides(corners):
        if y1 != y2:  # a ray to the right crosses the side
            found ^= ((y1 > y) != (y2 > y)) & (x < x1 + (y - y1) * (x2 - x1) / (y2 - y1))
    return found


def scans_apart(scans: Iterable[LaserScan]) -> Iterator[LaserScan]:
    """Scans between which the robot has moved or turned, by odometry."""
    last: LaserScan | None = None
    for scan in scans:
        if last is None or any(moved_or_turned(last, scan)):
            last = scan
            yield scan


def moved_or_turned(first: LaserScan, scan: LaserScan) -> tuple[bool, bool]:
    """Whether the robot has moved between two scans, and whether it has turned; neither without odometry."""
    x, y, theta = se2.between(first.T_odom_base, scan.T_odom_base).tolist()
    return math.hypot(x, y) > LEAST_MOVE_M, abs(theta) > LEAST_TURN_RAD


def body_sectors(scans: Iterable[LaserScan]) -> Sectors:
    """Sectors in which a laser sees the robot itself: they stay as they are while it drives and turns."""
    own = np.flatnonzero(np.isfinite(_own_m(scans)))
    if not len(own):
        return ()
    parts = np.split(own, np.flatnonzero(np.diff(own) > LARGEST_GAP_DEG) + 1)
    if len(parts) > 1 and parts[0][0] + 360 - parts[-1][-1] <= LARGEST_GAP_DEG:
        parts[0] = np.concatenate((parts.pop() - 360, parts[0]))
    return tuple(_sector(int(part[0]) - MARGIN_DEG, int(part[-1]) + 1 + MARGIN_DEG) for part in parts)


def body_radius_m(scans: Iterable[LaserScan], laser: LaserModel) -> float:
    """Distance from the base to the farthest return of the robot itself in the scans of a laser; 0 without one."""
    own_m = _own_m(scans)
    own = np.flatnonzero(np.isfinite(own_m))
    x, y, _ = laser.T_base_laser
    headings = np.radians(own + 0.5)
    return float(np.hypot(x + own_m[own] * np.cos(headings), y + own_m[own] * np.sin(headings)).max(initial=0.0))


def _own_m(scans: Iterable[LaserScan]) -> FloatArray:
    """The range of the robot itself in each degree, as in ``by_degree``; infinity where it is not seen."""
    own_m = np.full(360, np.inf)
    places = list(islice(scans_apart(scans), MOST_PLACES))
    turns = np.array([scan.T_odom_base[2] for scan in places])
    if len(places) < FEWEST_PLACES or np.hypot(np.cos(turns).mean(), np.sin(turns).mean()) > SHARPEST:
        return own_m
    ranges_m = np.stack([by_degree(scan) for scan in places])
    middle_m = np.median(ranges_m, axis=0)
    near = middle_m < LARGEST_BODY_M
    steady = np.mean(np.abs(ranges_m[:, near] - middle_m[near]) < SAME_M, axis=0) > STEADY
    own = np.flatnonzero(near)[steady]
    own_m[own] = middle_m[own]
    return own_m


def _sector(first_deg: int, last_deg: int) -> tuple[float, float]:
    """The sector with ends that a setting may have, and of one turn at most."""
    last_deg = min(last_deg, first_deg + 360)
    turn_deg = 360 if last_deg > 360 else 0
    return float(first_deg - turn_deg), float(last_deg - turn_deg)


def by_degree(scan: LaserScan) -> FloatArray:
    """The least range in each degree of the headings in ``base``, shape (360,); infinity without one."""
    is_return = (scan.ranges_m > 0.0) & (scan.ranges_m < scan.laser.max_range_m)
    degree = np.floor(np.remainder(_headings_deg(scan.laser), 360.0)).astype(np.intp) % 360
    found = np.full(360, np.inf)
    np.minimum.at(found, degree[is_return], scan.ranges_m[is_return].astype(np.float64))
    return found


def _headings_deg(laser: LaserModel) -> FloatArray:
    headings_rad = laser.T_base_laser[2] + laser.angle_min_rad + laser.angle_increment_rad * np.arange(laser.beam_count)
    return np.asarray(np.degrees(headings_rad))
