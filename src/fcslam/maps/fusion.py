"""One occupancy map from the keyscans of several robots, as the building is at the end of the newest period."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from fcslam.lidar.occupancy import Casting, OccupancyConfig, cast_periods, classify
from fcslam.records import FloatArray, Keyscan, LaserModel
from fcslam.runs.map_files import OccupancyMap


@dataclass(frozen=True, slots=True)
class Period:
    """A time in which sessions overlap. Within it, observations are not ordered by time."""

    sessions: tuple[str, ...]
    """In the order of their first keyscan."""
    first_s: float
    """Stamp of the first keyscan."""
    last_s: float
    """Stamp of the last keyscan."""


def periods_of(keyscans: Sequence[Keyscan]) -> list[Period]:
    """The periods of keyscans, from the oldest to the newest: sessions that overlap in time share a period."""
    spans: dict[str, tuple[float, float]] = {}
    for keyscan in keyscans:
        first_s, last_s = spans.get(keyscan.id.robot, (keyscan.stamp, keyscan.stamp))
        spans[keyscan.id.robot] = min(first_s, keyscan.stamp), max(last_s, keyscan.stamp)
    periods: list[Period] = []
    for first_s, last_s, session in sorted((*span, session) for session, span in spans.items()):
        if periods and first_s <= periods[-1].last_s:
            before = periods.pop()
            periods.append(Period((*before.sessions, session), before.first_s, max(before.last_s, last_s)))
        else:
            periods.append(Period((session,), first_s, last_s))
    return periods


def fuse(
    keyscans: Sequence[Keyscan],
    T_map_base: FloatArray,
    lasers: Mapping[str, Sequence[LaserModel]],
    config: OccupancyConfig,
) -> OccupancyMap:
    """Compute the occupancy map of keyscans; their order does not matter, their stamps do.

    Args:
        keyscans: N keyscans of any robots.
        T_map_base: their poses in ``map``, shape (N, 3), metres and radians.
        lasers: the lasers that each robot announced.
        config: the occupancy grid.

    Raises:
        ValueError: the numbers of poses and keyscans or of ranges and beams differ, or a pose is not finite.
        KeyError: a keyscan's robot has no lasers.
    """
    *_, newest = fuse_periods(keyscans, T_map_base, lasers, config, periods_of(keyscans))
    return newest


def fuse_periods(
    keyscans: Sequence[Keyscan],
    T_map_base: FloatArray,
    lasers: Mapping[str, Sequence[LaserModel]],
    config: OccupancyConfig,
    periods: Sequence[Period],
) -> Iterator[OccupancyMap]:
    """The map as it was after each of ``periods``, which hold every keyscan; else as ``fuse``. All have one size."""
    number = {session: k for k, period in enumerate(periods) for session in period.sessions}
    castings: list[list[Casting]] = [[] for _ in periods] or [[]]
    for keyscan, pose in zip(keyscans, np.asarray(T_map_base), strict=True):
        casting = keyscan.ranges_m, keyscan.laser_model(lasers[keyscan.id.robot]), pose
        castings[number[keyscan.id.robot]].append(casting)
    for grid in cast_periods(castings, config):
        yield OccupancyMap(classify(grid, config), grid.resolution_m, grid.origin_xy)
