"""One occupancy map from the keyscans of several robots, as the building is at the end of the newest period."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from fcslam.lidar.occupancy import Casting, OccupancyConfig, cast_periods, classify
from fcslam.maps.occupancy_map import OccupancyMap
from fcslam.maps.teammates import RobotPath, without_teammates
from fcslam.records import FloatArray, Keyscan, LaserModel


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
    senders: Mapping[str, str] | None = None,
) -> OccupancyMap:
    """Compute the occupancy map of keyscans; their order does not matter, their stamps do.

    ``T_map_base`` (N, 3) are the poses of the keyscans in ``map``, in metres and radians; ``lasers`` those that each
    robot announced. ``senders`` names each session's robot, to leave out points on other robots; None: all are drawn.
    """
    *_, newest = fuse_periods(keyscans, T_map_base, lasers, config, periods_of(keyscans), senders)
    return newest


def fuse_periods(
    keyscans: Sequence[Keyscan],
    T_map_base: FloatArray,
    lasers: Mapping[str, Sequence[LaserModel]],
    config: OccupancyConfig,
    periods: Sequence[Period],
    senders: Mapping[str, str] | None = None,
) -> Iterator[OccupancyMap]:
    """The map as it was after each of ``periods``, which hold every keyscan; else as ``fuse``. All have one size."""
    number = {session: k for k, period in enumerate(periods) for session in period.sessions}
    castings: list[list[Casting]] = [[] for _ in periods] or [[]]
    scans = [
        Casting(keyscan.ranges_m, keyscan.laser_model(lasers[keyscan.id.robot]), pose, keyscan.sweep)
        for keyscan, pose in zip(keyscans, np.asarray(T_map_base), strict=True)
    ]
    if senders is not None and len(set(senders.values())) > 1:
        scans = _without_teammates(keyscans, scans, senders, config)
    for keyscan, casting in zip(keyscans, scans, strict=True):
        castings[number[keyscan.id.robot]].append(casting)
    for grid in cast_periods(castings, config):
        yield OccupancyMap(classify(grid), grid.resolution_m, grid.origin_xy)


def _without_teammates(
    keyscans: Sequence[Keyscan], scans: list[Casting], senders: Mapping[str, str], config: OccupancyConfig
) -> list[Casting]:
    """The scans without the points that lie on robots of other senders, by the paths of the keyscans."""
    stamps = np.array([keyscan.stamp for keyscan in keyscans])
    sessions = np.array([keyscan.id.robot for keyscan in keyscans])
    poses = np.array([scan.T_map_base for scan in scans]).reshape(-1, 3)
    paths: dict[str, list[RobotPath]] = {}
    for session in dict.fromkeys(sessions.tolist()):
        rows = np.flatnonzero(sessions == session)
        rows = rows[np.argsort(stamps[rows], kind="stable")]
        paths.setdefault(senders[session], []).append(RobotPath(stamps[rows], poses[rows]))
    return without_teammates(scans, stamps, [senders[session] for session in sessions.tolist()], paths, config)
