"""Where users put a map, and the regions that they drew in it: changed cells, Nav2's keep-out mask, named areas."""

import json
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from fcslam.cloud.session_store import SessionStore
from fcslam.geometry import se2, se3
from fcslam.geometry.groups import SE2, SE3, Group
from fcslam.maps.occupancy_map import Occupancy, OccupancyMap, server_files
from fcslam.records import Change, FloatArray, KeyscanId, MapRegion, Placement, RegionUse, frozen

PoseOf = Callable[[KeyscanId], FloatArray]
"""Pose of a keyscan in its map, shape (P,)."""
_FRACTION_BITS = 6
"""Fractional bits of the coordinates that OpenCV takes: polygons are exact to a 64th of a cell."""
_MARGIN_CELLS = 1000
"""Polygons are cut off this far outside the map: 100 km in cells of 2 mm would overflow OpenCV's 32 bits."""
_CELLS = {RegionUse.ERASE: Occupancy.UNKNOWN, RegionUse.FREE: Occupancy.FREE}
"""Regions that change the map, and what their cells become."""


@dataclass(frozen=True, slots=True, eq=False)
class PlacedRegion:
    """A region in the coordinates of its map."""

    use: RegionUse
    name: str
    map_index: int
    polygon: FloatArray
    """Corners (x, y) in ``map``, shape (N, 2), metres."""


def T_placed_map(
    members: Sequence[str], sessions: SessionStore, pose_of: PoseOf, changes: Iterable[Change], group: Group
) -> FloatArray | None:
    """The motion that levels a map in space and puts it where users want it, shape (P,); None if nothing moves it.

    ``pose_of`` gives poses in the map as it is; of several placements the last one counts.
    """
    level = None if group is SE2 else _levelling(members, sessions, pose_of)
    placements = [change for change in changes if isinstance(change, Placement) and change.session in members]
    if not placements:
        return level
    last = placements[-1]
    T_map_keyscan = pose_of(sessions.nearest(last.session, last.stamp))
    if level is not None:
        T_map_keyscan = group.compose(level, T_map_keyscan)
    T = group.from_plane(se2.compose(np.array(last.pose), se2.inverse(group.to_plane(T_map_keyscan))))
    return T if level is None else group.compose(T, level)


def _levelling(members: Sequence[str], sessions: SessionStore, pose_of: PoseOf) -> FloatArray:
    """The rotation about the origin that makes the floors of a map level in the mean; its first base may lean."""
    seen = [voxels for session in members for voxels in sessions.voxel_maps(session)]
    if not seen:
        return SE3.identity
    poses, grounds = np.array([pose_of(voxels.id) for voxels in seen]), np.array([each.T_base_ground for each in seen])
    x, y, z = np.median(se3.rotation(SE3.compose(poses, grounds))[:, :, 2], axis=0)
    lean_rad = float(np.arctan2(np.hypot(x, y), z))
    axis = np.array([y, -x, 0.0]) / max(1e-12, float(np.hypot(x, y)))
    return SE3.exp(np.concatenate((np.zeros(3), lean_rad * axis)))


def placed_regions(
    map_indices: dict[str, int], sessions: SessionStore, pose_of: PoseOf, changes: Iterable[Change]
) -> tuple[PlacedRegion, ...]:
    """The regions whose sessions are in a map, at the present poses of the keyscans to which they are tied.

    ``map_indices``: number of each session's map; ``pose_of``: poses in the maps; ``changes``: edits in force.
    """
    regions = [change for change in changes if isinstance(change, MapRegion) and change.session in map_indices]
    return tuple(
        PlacedRegion(
            region.use,
            region.name,
            map_indices[region.session],
            frozen(se2.transform(pose_of(sessions.nearest(region.session, region.stamp)), np.array(region.polygon))),
        )
        for region in regions
    )


def with_regions(occupancy: OccupancyMap, regions: Sequence[PlacedRegion]) -> OccupancyMap:
    """The map with the cells that users erased or freed; of regions that overlap, the later one counts."""
    cells = occupancy.cells
    for region in regions:
        if region.use in _CELLS and (inside := _inside(occupancy, [region])).any():
            cells = np.where(inside, _CELLS[region.use], cells)
    return occupancy if cells is occupancy.cells else replace(occupancy, cells=frozen(cells, np.uint8))


def region_files(occupancy: OccupancyMap, stem: str, regions: Sequence[PlacedRegion]) -> dict[str, bytes]:
    """Files beside the map ``stem``: nothing where there is nothing to say.

    ``<stem>_keepout.pgm`` and ``.yaml`` are the mask of Nav2's keep-out filter, with the map's cells: occupied where
    robots must not enter, free elsewhere. ``<stem>_areas.geojson`` holds the named areas in metres of the map.
    """
    files: dict[str, bytes] = {}
    forbidden = [region for region in regions if region.use is RegionUse.KEEP_OUT]
    if forbidden:
        cells = np.where(_inside(occupancy, forbidden), Occupancy.OCCUPIED, Occupancy.FREE)
        mask = replace(occupancy, cells=frozen(cells, np.uint8))
        files |= server_files(f"{stem}_keepout", mask)
    if areas := [region for region in regions if region.use is RegionUse.AREA]:
        collection = {"type": "FeatureCollection", "features": list(map(_feature, areas))}
        files[f"{stem}_areas.geojson"] = (json.dumps(collection, indent=1) + "\n").encode()
    return files


def _inside(occupancy: OccupancyMap, regions: Sequence[PlacedRegion]) -> NDArray[np.bool_]:
    """Cells that lie in one of the regions or that its edge touches, shape (H, W)."""
    mask = np.zeros(occupancy.cells.shape, np.uint8)
    for region in regions:
        cells: FloatArray = (region.polygon - occupancy.origin_xy) / occupancy.resolution_m - 0.5
        for axis in (0, 1):
            cells = _below(cells, axis, mask.shape[1 - axis] + _MARGIN_CELLS)
            cells = -_below(-cells, axis, _MARGIN_CELLS)
        if len(cells):
            corners = np.round(cells * (1 << _FRACTION_BITS)).astype(np.int32)
            cv2.fillPoly(mask, [corners], 1, shift=_FRACTION_BITS)
    return mask.astype(bool)


def _below(corners: FloatArray, axis: int, limit: float) -> FloatArray:
    """The part of a polygon (N, 2) whose coordinate ``axis`` is at most ``limit``, shape (M, 2).

    Of a part in several pieces, sides along the limit connect the pieces.
    """
    excess = corners[:, axis] - limit
    kept = excess <= 0.0
    crosses = kept != np.roll(kept, -1)
    share = np.where(crosses, excess, 0.0) / np.where(crosses, excess - np.roll(excess, -1), 1.0)
    crossings = corners + share[:, None] * (np.roll(corners, -1, axis=0) - corners)
    part: FloatArray = np.stack((corners, crossings), axis=1)[np.stack((kept, crosses), axis=1)]
    return part


def _feature(area: PlacedRegion) -> dict[str, object]:
    ring = [[round(x, 4), round(y, 4)] for x, y in (*area.polygon.tolist(), area.polygon[0].tolist())]
    return {
        "type": "Feature",
        "properties": {"name": area.name, "map": area.map_index},
        "geometry": {"type": "Polygon", "coordinates": [ring]},
    }
