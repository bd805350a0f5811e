"""Changes in a building between two periods: cells that became occupied or free, as regions and as a picture."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from fcslam.maps.drawing import highlighted_png
from fcslam.maps.fusion import Period
from fcslam.maps.occupancy_map import Cells, Occupancy, OccupancyMap

Mask = NDArray[np.bool_]

TOLERANCE_M: Final = 0.10
"""A surface that has moved by less is the same one: poses are not more accurate over several periods."""
JOINED_M: Final = 1.5 * TOLERANCE_M
"""Changed cells this close together are one region."""
SMALLEST_M2: Final = 0.02
"""Smaller regions are not reported: eight cells of 0.05 m."""

APPEARED, DISAPPEARED = "appeared", "disappeared"


@dataclass(frozen=True, slots=True)
class ChangedRegion:
    """A connected area whose surfaces appeared or disappeared."""

    kind: str
    """``appeared`` or ``disappeared``."""
    area_m2: float
    """Area of its changed cells."""
    x: float
    """Mean of the changed cells in ``map``, metres."""
    y: float
    sessions: tuple[str, ...]
    """The sessions of the period that observed most of it first."""


@dataclass(frozen=True, slots=True, eq=False)
class Changes:
    """Changes in a map from the end of one period to the end of a later one."""

    now: OccupancyMap
    """The map at the later time."""
    appeared: Mask
    """Cells of ``now`` that became occupied, shape (H, W)."""
    disappeared: Mask
    """Cells of ``now`` that became free, shape (H, W)."""
    compared: Mask
    """Cells of ``now`` that were known at both times, shape (H, W)."""
    regions: tuple[ChangedRegion, ...]
    """The largest first."""

    def layer(self, changed: Mask) -> OccupancyMap:
        """``appeared`` or ``disappeared`` as a map: occupied where it changed, free where it did not, else unknown."""
        cells = np.where(self.compared, Occupancy.FREE, Occupancy.UNKNOWN).astype(np.uint8)
        cells[changed] = Occupancy.OCCUPIED
        return OccupancyMap(cells, self.now.resolution_m, self.now.origin_xy)

    def png(self) -> bytes:
        """The map with what appeared and what disappeared in two colours, and a legend."""
        return highlighted_png(self.now, self.appeared, self.disappeared, (APPEARED, DISAPPEARED))


def compare(maps: Sequence[OccupancyMap], periods: Sequence[Period]) -> Changes:
    """Find the changes from the first of ``maps`` to the last.

    Only cells that are known in both count, and surfaces that moved by more than ``TOLERANCE_M``. The maps are those
    after each of ``periods``, all of one size, 1 or more.
    """
    then, now = maps[0], maps[-1]
    reach = max(1, round(TOLERANCE_M / now.resolution_m))
    compared = (then.cells != Occupancy.UNKNOWN) & (now.cells != Occupancy.UNKNOWN)
    was, is_ = then.cells == Occupancy.OCCUPIED, now.cells == Occupancy.OCCUPIED
    masks = {APPEARED: compared & is_ & ~grown(was, reach), DISAPPEARED: compared & was & ~grown(is_, reach)}
    latest = _latest_change(maps)
    found: list[ChangedRegion] = []
    for kind, mask in masks.items():
        regions, kept = _regions(kind, mask, latest, now, periods)
        found += regions
        masks[kind] = kept
    found.sort(key=lambda region: (-region.area_m2, region.x, region.y))
    return Changes(now, masks[APPEARED], masks[DISAPPEARED], compared, tuple(found))


def _latest_change(maps: Sequence[OccupancyMap]) -> NDArray[np.int64]:
    """For each cell the number of the newest map whose state differs from the previous one; 0 if none."""
    latest = np.zeros(maps[0].cells.shape, np.int64)
    for number in range(1, len(maps)):
        latest[maps[number].cells != maps[number - 1].cells] = number
    return latest


def _regions(
    kind: str, mask: Mask, latest: NDArray[np.int64], now: OccupancyMap, periods: Sequence[Period]
) -> tuple[list[ChangedRegion], Mask]:
    side = now.resolution_m
    count, labels = cv2.connectedComponents(
        grown(mask, max(1, round(JOINED_M / (2.0 * side)))).astype(np.uint8), connectivity=8
    )
    kept, regions = np.zeros_like(mask), []
    rows, columns = np.nonzero(mask)
    owner = labels[rows, columns]
    order = np.argsort(owner, kind="stable")
    for members in np.split(order, np.searchsorted(owner[order], np.arange(2, count))):
        area_m2 = len(members) * side**2
        if area_m2 < SMALLEST_M2:
            continue
        row, column = rows[members], columns[members]
        kept[row, column] = True
        x, y = np.array(now.origin_xy) + side * (np.array((column.mean(), row.mean())) + 0.5)
        period = periods[int(np.bincount(latest[row, column]).argmax())]
        regions.append(ChangedRegion(kind, area_m2, float(x), float(y), period.sessions))
    return regions, kept


def grown(mask: Mask, cells: int) -> Mask:
    """The mask, grown to all cells within this many rows and columns."""
    side = 2 * cells + 1
    grown: Cells = np.asarray(cv2.dilate(mask.astype(np.uint8), np.ones((side, side), np.uint8)), np.uint8)
    return np.asarray(grown > 0)
