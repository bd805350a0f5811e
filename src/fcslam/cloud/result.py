"""The result of a fleet: all closures decided, all robots placed in maps."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from fcslam.cloud.closure_log import ClosureEntry
from fcslam.cloud.edits import is_cut
from fcslam.cloud.joint_graph import JointGraph
from fcslam.cloud.placement import PlacedRegion, T_placed_map, placed_regions
from fcslam.cloud.session_store import SessionStore
from fcslam.geometry.groups import SE2, Group
from fcslam.graph.evidence import ClusterEvidence
from fcslam.graph.pose_graph import PoseGraph
from fcslam.records import (
    Change,
    ClosureStatus,
    FloatArray,
    Keyscan,
    KeyscanFix,
    KeyscanId,
    LaserModel,
    LoopClosure,
    TagSighting,
    VoxelMap,
    frozen,
)


@dataclass(frozen=True, slots=True)
class SpacePath:
    """A robot's path in space, and what it saw there."""

    T_map_base: FloatArray
    """Pose at each stamp, in the frame of its map, shape (N, 7)."""
    T_local_base: FloatArray
    """Pose at each stamp, in the robot's own map, shape (N, 7)."""
    voxel_maps: tuple[VoxelMap, ...]


@dataclass(frozen=True, slots=True)
class MappedRobot:
    """One robot in the result."""

    robot: str
    map_index: int
    """0 is the map of most robots."""
    stamps: FloatArray
    """Stamps of its keyscans, shape (N,)."""
    keyscans: tuple[Keyscan, ...]
    """The keyscans that make the map, ascending; keyscans of forgotten places are released."""
    T_map_base: FloatArray
    """Pose at each stamp, in the frame of its map, shape (N, 3)."""
    T_local_base: FloatArray
    """Pose at each stamp in the robot's own map, made without others, shape (N, 3); the origin is its first keyscan."""
    variables: NDArray[np.int64]
    """Number of each keyscan in the result's pose graph, shape (N,)."""
    lasers: tuple[LaserModel, ...]
    """As the robot announced them."""
    floor: str = ""
    """Floor that the session named; empty: none."""
    fixes: tuple[KeyscanFix, ...] = ()
    """Fixes of satellite navigation at its keyscans."""
    space: "SpacePath | None" = None
    """Its poses with six degrees of freedom; None in the plane."""

    def numbers(self) -> NDArray[np.int64]:
        """Rows of ``keyscans`` in stamps and poses, ascending."""
        return np.array([keyscan.id.number for keyscan in self.keyscans], np.int64)


@dataclass(frozen=True, slots=True)
class FleetResult:
    """Poses, decided closures and the pose graph."""

    robots: tuple[MappedRobot, ...]
    closures: tuple[LoopClosure, ...]
    """Between robots and within them."""
    graph: PoseGraph
    """All keyscans at their optimized poses, with the accepted constraints; of a fleet in space its projection."""
    regions: tuple[PlacedRegion, ...] = ()
    """Regions that users drew in the maps."""
    joins: Mapping[frozenset[str], ClusterEvidence] = field(default_factory=dict)
    """On what evidence two robots share a map, where closures between them agree."""
    sightings: tuple[TagSighting, ...] = ()
    """Sightings of the tags that the robots saw."""
    space_graph: PoseGraph | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Fusion:
    """Which robots share a map, their poses, and the closures behind them."""

    maps: Sequence[Sequence[str]]
    """Robots of each map, maps and robots in the order in which they started."""
    T_map_base: Mapping[str, FloatArray]
    """Every robot's keyscans in the frame of its map, shape (N, P)."""
    T_local_base: Mapping[str, FloatArray]
    """Every robot's keyscans in its own map, shape (N, P)."""
    closures: tuple[LoopClosure, ...]
    """In the order in which they were found, decided."""
    joins: Mapping[frozenset[str], ClusterEvidence] = field(default_factory=dict)
    """As in ``FleetResult``."""

    def pose(self, keyscan: KeyscanId) -> FloatArray:
        """Pose of a keyscan in its map, shape (P,)."""
        pose: FloatArray = self.T_map_base[keyscan.robot][keyscan.number]
        return pose


def map_indices(maps: Sequence[Sequence[str]]) -> dict[str, int]:
    """Number of each robot's map: the map of most robots is 0, and of two as large the one that started first."""
    by_size = sorted(maps, key=lambda robots: -len(robots))
    return {robot: k for k, robots in enumerate(by_size) for robot in robots}


def conclude(
    sessions: SessionStore,
    graph: JointGraph,
    closures: Iterable[ClosureEntry],
    fusion: Fusion,
    changes: Sequence[Change],
) -> FleetResult:
    """Collect the result of the robots of ``fusion``, whose closures are those of the entries.

    ``changes`` are the edits in force; those of closures were taken into account before.
    """
    group = graph.group
    fusion = _placed(fusion, sessions, changes, group)
    index = map_indices(fusion.maps)
    variables = graph.held_variables(fusion.T_map_base)
    robots = tuple(
        MappedRobot(
            robot,
            index[robot],
            frozen(sessions.stamps(robot)),
            tuple(k for k in sessions.keyscans(robot) if not is_cut(robot, k.stamp, changes)),
            frozen(group.to_plane(fusion.T_map_base[robot])),
            frozen(group.to_plane(fusion.T_local_base[robot])),
            frozen(variables[robot], np.int64),
            sessions.lasers(robot),
            sessions.floor(robot),
            tuple(fix for fix in sessions.fixes(robot) if not is_cut(robot, sessions.stamp(fix.id), changes)),
            None if group is SE2 else _space_path(robot, sessions, fusion, changes),
        )
        for robot in sessions.robots
        if robot in index
    )
    left_out = {
        entry.edge
        for entry, closure in zip(closures, fusion.closures, strict=True)
        if closure.status is not ClosureStatus.ACCEPTED
    }
    regions = placed_regions(index, sessions, lambda keyscan: group.to_plane(fusion.pose(keyscan)), changes)
    held = graph.held(fusion.T_map_base, left_out)
    space_graph = None if group is SE2 else held
    return FleetResult(robots, fusion.closures, held.to_plane(), regions, fusion.joins, space_graph=space_graph)


def _space_path(robot: str, sessions: SessionStore, fusion: Fusion, changes: Sequence[Change]) -> SpacePath:
    kept = tuple(
        voxels for voxels in sessions.voxel_maps(robot) if not is_cut(robot, sessions.stamp(voxels.id), changes)
    )
    return SpacePath(fusion.T_map_base[robot], fusion.T_local_base[robot], kept)


def _placed(fusion: Fusion, sessions: SessionStore, changes: Sequence[Change], group: Group) -> Fusion:
    T_map_base = dict(fusion.T_map_base)
    for members in fusion.maps:
        T = T_placed_map(members, sessions, fusion.pose, changes, group)
        if T is not None:
            T_map_base |= {session: frozen(group.compose(T, T_map_base[session])) for session in members}
    return replace(fusion, T_map_base=T_map_base)
