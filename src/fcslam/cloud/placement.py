"""Where users put a map: its coordinate frame, and the regions that they drew in it."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from fcslam.cloud.session_store import SessionStore
from fcslam.geometry import se2
from fcslam.records import Change, FloatArray, KeyscanId, MapRegion, Placement, RegionUse, frozen

PoseOf = Callable[[KeyscanId], FloatArray]
"""Pose of a keyscan in its map, shape (3,)."""


@dataclass(frozen=True, slots=True, eq=False)
class PlacedRegion:
    """A region in the coordinates of its map."""

    use: RegionUse
    name: str
    map_index: int
    polygon: FloatArray
    """Corners (x, y) in ``map``, shape (N, 2), metres."""


def T_placed_map(
    members: Sequence[str], sessions: SessionStore, pose_of: PoseOf, changes: Iterable[Change]
) -> FloatArray | None:
    """The motion that puts a map where users want it, shape (3,); None if no placement names one of its sessions.

    Args:
        members: the sessions of the map.
        sessions: their keyscans.
        pose_of: poses in the map as it is.
        changes: edits in force; of several placements the last one counts.
    """
    placements = [change for change in changes if isinstance(change, Placement) and change.session in members]
    if not placements:
        return None
    last = placements[-1]
    T_map_keyscan = pose_of(sessions.nearest(last.session, last.stamp))
    return se2.compose(np.array(last.pose), se2.inverse(T_map_keyscan))


def placed_regions(
    map_indices: dict[str, int], sessions: SessionStore, pose_of: PoseOf, changes: Iterable[Change]
) -> tuple[PlacedRegion, ...]:
    """The regions whose sessions are in a map, at the present poses of the keyscans to which they are tied.

    Args:
        map_indices: number of each session's map.
        sessions: their keyscans.
        pose_of: poses in the maps.
        changes: edits in force.
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
