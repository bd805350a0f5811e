"""Frontiers of a map: where its free cells end at unknown ones."""

from collections.abc import Iterator, Sequence
from typing import Final, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from fcslam.maps.occupancy_map import Occupancy, OccupancyMap
from fcslam.records import FloatArray

CELL_M: Final = 0.1
"""Least side of a cell of the search grid."""
LARGEST_GRID: Final = 400_000
"""Cells of the search grid; in a larger map they are wider."""
VIEW_M: Final = 5.0
"""Side of the square around a frontier whose unknown area counts as its gain."""
SAME_M: Final = 1.0
"""Frontiers this near in two moments are the same one. A robot farther from a passable cell reaches nothing."""
POCKET_M2: Final = SAME_M**2
"""Smaller areas are no place for a robot."""
MARGIN: Final = 3
"""Unknown cells of the search grid on each side of the map."""

Cells = NDArray[np.bool_]


class Frontier(NamedTuple):
    """A connected boundary between free and unknown cells."""

    point: tuple[float, float]
    """A place on it that a robot can reach, metres in the frame of the map."""
    length_m: float
    gain_m2: float
    """Unknown area around it."""
    distances_m: tuple[float, ...]
    """Length of the shortest path from each robot; infinite if no path leads there."""


def frontiers(
    occupancy: OccupancyMap, robots_xy: FloatArray, radius_m: float, with_paths: bool = True
) -> list[Frontier]:
    """The frontiers that one of the robots can reach, that with the largest gain first.

    ``robots_xy`` (R, 2) in metres, in the frame of the map. The centre of a robot stays ``radius_m`` from occupied
    cells, and it passes no unknown cell. Without paths, ``distances_m`` are empty.
    """
    free, occupied, side_m, origin = search_grid(occupancy)
    if not free.any():
        return []
    passable = passable_cells(free, occupied, side_m, radius_m)
    unknown = cv2.morphologyEx((~free & ~occupied).astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    beside = cv2.dilate(unknown, cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3)))
    _, parts, boxes, _ = cv2.connectedComponentsWithStats(free & beside)
    window = max(1, round(VIEW_M / side_m))
    share = cv2.blur(unknown.astype(np.float32), (window, window), borderType=cv2.BORDER_REPLICATE)
    gains_m2 = (window * side_m) ** 2 * share
    starts = start_cells(passable, robots_xy, side_m, origin)
    _, areas = cv2.connectedComponents(passable.astype(np.uint8))
    reached = np.isin(areas, [areas[start] for start in starts if start is not None])
    points, sizes = [], []
    for number, (left, top, width, height, _) in enumerate(boxes[1:].tolist(), 1):
        cells = np.array((top, left)) + np.argwhere(parts[top : top + height, left : left + width] == number)
        near = cells[reached[tuple(cells.T)]]
        if len(cells) * side_m >= 2.0 * radius_m and len(near):
            points.append(near[np.argmin(((near - cells.mean(axis=0)) ** 2).sum(axis=1))])
            sizes.append(len(cells) * side_m)
    at = tuple(np.array(points, np.int64).reshape(-1, 2).T)
    fields = list(path_lengths(passable, starts, side_m)) if with_paths else []
    ways = np.array([field[at] for field in fields]).reshape(len(fields), len(points))
    places = np.array(origin) + side_m * (np.stack(at[::-1], axis=-1) + 0.5)
    found = [
        Frontier((x, y), length_m, gain_m2, tuple(lengths))
        for (x, y), length_m, gain_m2, lengths in zip(
            places.tolist(), sizes, gains_m2[at].tolist(), ways.T.tolist(), strict=True
        )
    ]
    return sorted(found, key=lambda one: (-one.gain_m2, one.point))


def search_grid(occupancy: OccupancyMap) -> tuple[Cells, Cells, float, tuple[float, float]]:
    """Free and occupied cells of the known part of the map in wider cells, their side, and where cell (0, 0) begins."""
    rows, columns = np.nonzero(occupancy.cells)
    if not len(rows):
        return *np.zeros((2, 0, 0), bool), CELL_M, occupancy.origin_xy
    low, high = (np.array((of(rows), of(columns))) for of in (np.min, np.max))
    known = occupancy.cells[low[0] : high[0] + 1, low[1] : high[1] + 1]
    wide = max(1, round(CELL_M / occupancy.resolution_m), int(np.ceil(np.sqrt(known.size / LARGEST_GRID))))
    # Beyond the map's edge all is unknown, so the edge is a frontier, too.
    height, width = (-(-size // wide) + 2 * MARGIN for size in known.shape)
    edge = MARGIN * wide
    whole = np.zeros((height * wide, width * wide), np.uint8)
    whole[edge : edge + known.shape[0], edge : edge + known.shape[1]] = known
    blocks = whole.reshape(height, wide, width, wide)
    occupied = (blocks == Occupancy.OCCUPIED).any(axis=(1, 3))
    free = (blocks == Occupancy.FREE).any(axis=(1, 3)) & ~occupied
    y, x = (float(start) * occupancy.resolution_m for start in low - edge)
    side_m = wide * occupancy.resolution_m
    return free, occupied, side_m, (occupancy.origin_xy[0] + x, occupancy.origin_xy[1] + y)


def passable_cells(free: Cells, occupied: Cells, side_m: float, radius_m: float) -> Cells:
    """Where the centre of a robot may be, without pockets between obstacles."""
    clear_m = side_m * cv2.distanceTransform((~occupied).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    _, areas, boxes, _ = cv2.connectedComponentsWithStats((free & (clear_m > radius_m)).astype(np.uint8))
    is_wide = boxes[:, cv2.CC_STAT_AREA] * side_m**2 >= POCKET_M2
    is_wide[0] = False
    return np.asarray(is_wide[areas])


def start_cells(
    passable: Cells, robots_xy: FloatArray, side_m: float, origin: tuple[float, float]
) -> list[tuple[int, int] | None]:
    """The passable cell nearest to each robot; None if that is too far away."""
    if not passable.any():
        return [None] * len(robots_xy)
    cells = np.argwhere(passable)
    found: list[tuple[int, int] | None] = []
    for at in np.floor((robots_xy - origin) / side_m).astype(np.int64)[:, ::-1]:
        start = cells[np.argmin(((cells - at) ** 2).sum(axis=1))]
        is_near = side_m * float(np.hypot(*(start - at))) <= SAME_M
        found.append((int(start[0]), int(start[1])) if is_near else None)
    return found


def path_lengths(passable: Cells, starts: Sequence[tuple[int, int] | None], side_m: float) -> Iterator[FloatArray]:
    """Length of the shortest path from each cell ``starts`` to all cells, shape (H, W) each; infinite without one."""
    from scipy.sparse.csgraph import dijkstra  # SciPy takes long to load, and a certificate needs no paths

    from fcslam.geometry.cell_graph import cell_graph

    numbers = np.cumsum(passable).reshape(passable.shape) - 1
    graph = cell_graph(passable, side_m, np.ones(passable.shape))
    for start in starts:
        field = np.full(passable.shape, np.inf)
        if start is not None:
            field[passable] = dijkstra(graph, indices=numbers[start])
        yield field
