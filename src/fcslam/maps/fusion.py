"""One occupancy map from the keyscans of several robots, as the building is at the end of the newest period.

Robots that keep their ranges send a map of their own; such maps are laid together.
"""

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from fcslam.compiled import njit
from fcslam.geometry import se2
from fcslam.lidar.occupancy import Casting, OccupancyConfig, cast_periods, classify
from fcslam.maps.joint_tiles import tiled_map
from fcslam.maps.occupancy_map import OccupancyMap
from fcslam.maps.teammates import RobotPath, without_teammates
from fcslam.records import FloatArray, Keyscan, LaserModel, MapTile


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
    robot announced. ``senders`` names the robot of each session, if points on other robots are not drawn; None: all
    are.
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


def joined_tiles(tiles: Iterable[MapTile]) -> OccupancyMap:
    """One map, in their frame, of tiles of one resolution, at least one."""
    at = {(tile.row, tile.column): tile for tile in tiles}
    return tiled_map({number: tile.cells for number, tile in at.items()}, next(iter(at.values())).resolution_m)


def laid_together(maps: Sequence[tuple[OccupancyMap, FloatArray]], maximum_cells: int) -> OccupancyMap:
    """Maps moved as a whole into one frame.

    A cell is occupied if it is in one of the maps, else free if it is in one, so no wall is lost. Each map has a pose
    (3,) in the common frame, in metres and radians. Cells are those of the first map, doubled until they are few
    enough.
    """
    boxes = [_box(occupancy, pose) for occupancy, pose in maps]
    low, high = np.min([box[0] for box in boxes], axis=0), np.max([box[1] for box in boxes], axis=0)
    resolution_m = maps[0][0].resolution_m
    while np.prod(np.ceil(high / resolution_m) - np.floor(low / resolution_m)) > maximum_cells:
        resolution_m *= 2.0
    column, row = np.floor(low / resolution_m).astype(np.int64)
    width, height = np.maximum(np.ceil(high / resolution_m).astype(np.int64) - (column, row), 1)
    cells = np.zeros((height, width), np.uint8)
    for occupancy, pose in maps:
        samples = max(1, math.ceil(resolution_m / occupancy.resolution_m - 1e-9))
        target = np.array((column, row)) * resolution_m, resolution_m
        source = np.array(occupancy.origin_xy), occupancy.resolution_m
        _lay(cells, *target, occupancy.cells, *source, np.asarray(se2.inverse(pose)), samples)
    return OccupancyMap(cells, resolution_m, (float(column * resolution_m), float(row * resolution_m)))


def _box(occupancy: OccupancyMap, pose: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Lowest and highest (x, y) of the corners of a map at a pose (3,)."""
    low = np.array(occupancy.origin_xy)
    high = low + occupancy.resolution_m * np.array(occupancy.cells.shape[::-1])
    corners = se2.transform(pose, np.array([low, (high[0], low[1]), high, (low[0], high[1])]))
    return corners.min(axis=0), corners.max(axis=0)


@njit
def _lay(cells, origin, resolution_m, source, source_origin, source_resolution_m, T_source_target, samples):  # type: ignore[no-untyped-def]
    """Raise every cell to the highest state of the source at ``samples`` by ``samples`` points of it."""
    cosine, sine = np.cos(T_source_target[2]), np.sin(T_source_target[2])
    for row in range(cells.shape[0]):
        for column in range(cells.shape[1]):
            state = cells[row, column]
            for k in range(samples * samples):
                x = origin[0] + (column + (k % samples + 0.5) / samples) * resolution_m
                y = origin[1] + (row + (k // samples + 0.5) / samples) * resolution_m
                u = (cosine * x - sine * y + T_source_target[0] - source_origin[0]) / source_resolution_m
                v = (sine * x + cosine * y + T_source_target[1] - source_origin[1]) / source_resolution_m
                if 0.0 <= u < source.shape[1] and 0.0 <= v < source.shape[0]:
                    state = max(state, source[int(v), int(u)])
            cells[row, column] = state
