"""Keyframes of a robot with a 3D LiDAR, the motions between them, and local maps of several keyframes."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from fcslam.geometry import se3
from fcslam.geometry.voxels import VOXEL_STEPS, to_steps, voxelised
from fcslam.lidar3d.ground import Vertical, levelled
from fcslam.lidar3d.surfels import SurfelMap
from fcslam.lidar3d.tracker import MOST_POINTS, Tracked, fit_rigid, inverse, thinned
from fcslam.lidar3d.voxel_matching import PreparedMap, show_one_place
from fcslam.records import STEP_M, FloatArray, KeyscanId, VoxelMap
from fcslam.sources.clouds_in_space import floor_at

_STEP_M, _STEP_RAD = 0.5, 0.4
"""Motion after which a turn of the LiDAR is a keyframe."""
_LOCAL_MAP_M: Final = 2.5
"""Travel from one local map to the next."""
_REACH: Final = 6
"""Keyframes before and after that of a local map whose points it has."""
_CELL_M: Final = VOXEL_STEPS * STEP_M
"""A keyframe keeps one point in each such cell."""
_DRIFT: Final = np.array([1e-3] * 3 + [5e-4] * 3)
"""Standard deviations that every motion between keyframes has at least."""
_APART_M: Final = 12.0
"""Travel between two local maps of a closure, at least."""
_NEAR_M, _DRIFT_SHARE = 3.0, 0.02
"""Local maps closer than this, and this share of the travel between them, may show the same place."""
_MOST_TRIED: Final = 2
_EXPLAINED, _OVERLAP = 0.9, 0.5
"""Shares of a closure's points: on a surface of those near one, and near a surface of all."""
_CLOSURE_SIGMA: Final = np.array([3e-3] * 3 + [1e-3] * 3)
_UNMEASURED: Final = np.array([1.0] * 3 + [0.3] * 3)
"""Standard deviations of a closure where surfaces do not fix it."""
_HEIGHTS: Final = 0.3, 2.6, 10
"""Lowest and highest point over the floor that show whether a column is a wall, and the number of heights between."""
_LEAST_HEIGHTS: Final = 3
"""Heights at which a column of a wall is occupied; a table has fewer."""
_COLUMN_M: Final = 0.1
"""Side of a column."""


@dataclass(frozen=True, slots=True, eq=False)
class MappedTurn:
    """A turn of the LiDAR that carries the graph."""

    number: int
    T_odom_base: FloatArray
    travel_m: float
    points: FloatArray
    """Shape (N, 3), in ``base``."""
    origin: FloatArray
    """Position of the sensor in ``base``."""
    height_m: float
    """Height of ``base`` above the floor."""


@dataclass(frozen=True, slots=True, eq=False)
class KeyframeMotion:
    """A measured motion between two keyframes."""

    i: int
    j: int
    T_i_j: FloatArray
    information: FloatArray


class Keyframes:
    """Chooses keyframes from tracked turns, and measures the motions between them."""

    def __init__(self) -> None:
        self.newest: MappedTurn | None = None
        self.vertical = Vertical()
        self.covariance: FloatArray = np.zeros((6, 6))
        """Covariance of the pose relative to the newest keyframe."""

    def add(self, tracked: Tracked, force: FloatArray | None) -> tuple[MappedTurn | None, KeyframeMotion | None]:
        """The turn as a keyframe, with the motion from the one before, or None; ``force`` is that of the IMU
        since the turn before."""
        self.vertical.feel(tracked.stamp, tracked.T_odom_base, force)
        back = se3.adjoint(se3.inverse(tracked.motion))
        predicted = back @ self.covariance @ back.T + np.diag(tracked.motion_sigma**2)
        information = inverse(predicted) + tracked.measured
        self.covariance = inverse(information)
        if self.newest is None:
            return self._keyframe(tracked, 0, 0.0), None
        T = se3.between(self.newest.T_odom_base, tracked.T_odom_base)
        tangent = se3.log(T)
        if tracked.is_poor or (np.linalg.norm(tangent[:3]) < _STEP_M and np.linalg.norm(tangent[3:]) < _STEP_RAD):
            return None, None
        motion = KeyframeMotion(
            self.newest.number,
            self.newest.number + 1,
            T,
            inverse(self.covariance + np.diag(_DRIFT**2)),
        )
        travel_m = self.newest.travel_m + float(np.linalg.norm(T[:3]))
        self.covariance = np.zeros((6, 6))
        return self._keyframe(tracked, motion.j, travel_m), motion

    def _keyframe(self, tracked: Tracked, number: int, travel_m: float) -> MappedTurn:
        floor = floor_at(tracked.points)
        self.vertical.take(None if floor is None else se3.rotation(tracked.T_odom_base) @ floor[0])
        self.newest = MappedTurn(
            number,
            tracked.T_odom_base,
            travel_m,
            tracked.points[thinned(tracked.points, _CELL_M)],
            tracked.origin,
            0.0 if floor is None else -floor[1],
        )
        return self.newest


@dataclass(frozen=True, slots=True, eq=False)
class SurfaceMap:
    """The points of several keyframes around one."""

    anchor: MappedTurn
    first: int
    last: int
    points: FloatArray
    """In ``base`` of the anchor, shape (N, 3)."""
    scans: NDArray[np.int64]
    """Row of ``origins`` for each point, shape (N,)."""
    origins: FloatArray
    """Where the scanner was, shape (M, 3)."""

    def surfels(self) -> SurfelMap:
        """Its surfaces."""
        surfels = SurfelMap()
        surfels.add(self.points, self.points - self.origins[self.scans], 1.0)
        return surfels

    def voxel_map(self, robot: str, up: FloatArray) -> VoxelMap:
        """The local map as it is sent; ``up`` is the vertical in ``odom``."""
        T_odom_ground = levelled(self.anchor.T_odom_base, up, self.anchor.height_m)
        T_base_ground = se3.between(self.anchor.T_odom_base, T_odom_ground)
        to_ground = se3.inverse(T_base_ground)
        origins = se3.transform(to_ground, self.origins)
        points, seen_from = voxelised(se3.transform(to_ground, self.points), self.scans, origins)
        identifier = KeyscanId(robot, self.anchor.number)
        return VoxelMap(identifier, self.first, self.last, T_base_ground, points, to_steps(origins), seen_from)


class SurfaceMaps:
    """Makes local maps of keyframes as they come, and finds closures between them."""

    def __init__(self) -> None:
        self.recent: list[MappedTurn] = []
        """The newest keyframes."""
        self._maps: list[SurfaceMap] = []
        self._next_m = 0.0

    def add(self, keyframe: MappedTurn) -> SurfaceMap | None:
        """Take the next keyframe; returns the local map that is complete with it."""
        self.recent = [*self.recent[-2 * _REACH :], keyframe]
        anchor = self.recent[-1 - _REACH] if len(self.recent) > _REACH else None
        if anchor is None or anchor.travel_m < self._next_m:
            return None
        return self._around(anchor)

    def show_place_of(self, turns: Sequence[Tracked]) -> bool:
        """Whether the newest keyframes and the turns after them show one place, so that the robot is not lost."""
        T_odom_base = turns[0].T_odom_base
        return show_one_place(_prepared(self.recent, T_odom_base), _prepared(turns, T_odom_base))

    def finish(self) -> SurfaceMap | None:
        """The last local map of a drive, if the newest keyframes are in none."""
        rest = [each for each in self.recent if each.travel_m >= self._next_m]
        return self._around(rest[len(rest) // 2]) if rest else None

    def _around(self, anchor: MappedTurn) -> SurfaceMap:
        self._next_m = anchor.travel_m + _LOCAL_MAP_M
        around = [each for each in self.recent if abs(each.number - anchor.number) <= _REACH]
        T_anchor = [se3.between(anchor.T_odom_base, each.T_odom_base) for each in around]
        points = [se3.transform(T, each.points) for T, each in zip(T_anchor, around, strict=True)]
        scans = np.repeat(np.arange(len(around)), [len(each) for each in points])
        origins = np.array([se3.transform(T, each.origin[None])[0] for T, each in zip(T_anchor, around, strict=True)])
        return SurfaceMap(anchor, around[0].number, around[-1].number, np.concatenate(points), scans, origins)

    def closures(self, new: SurfaceMap) -> list[KeyframeMotion]:
        """Motions from earlier local maps to a new one that its surfaces confirm; then remembers it."""
        found = []
        for old in self._candidates(new):
            start = se3.between(old.anchor.T_odom_base, new.anchor.T_odom_base)
            chosen = new.points[thinned(new.points, 2.0 * _CELL_M, MOST_POINTS)]
            T, measured, on_surface, near = fit_rigid(old.surfels(), chosen, start)
            if on_surface > _EXPLAINED * near and near > _OVERLAP * len(chosen):
                covariance = inverse(measured + np.diag(_UNMEASURED**-2)) + np.diag(_CLOSURE_SIGMA**2)
                found.append(KeyframeMotion(old.anchor.number, new.anchor.number, T, inverse(covariance)))
        kept = thinned(new.points, _CELL_M)  # several keyframes saw the same
        self._maps.append(replace(new, points=new.points[kept], scans=new.scans[kept]))
        return found

    def _candidates(self, new: SurfaceMap) -> list[SurfaceMap]:
        at, travel_m = new.anchor.T_odom_base[:3], new.anchor.travel_m
        near = []
        for old in self._maps:
            apart_m = travel_m - old.anchor.travel_m
            distance_m = float(np.linalg.norm(old.anchor.T_odom_base[:3] - at))
            if apart_m > _APART_M and distance_m < _NEAR_M + _DRIFT_SHARE * apart_m:
                near.append((distance_m, old.anchor.number, old))
        return [old for _, _, old in sorted(near, key=lambda each: each[:2])[:_MOST_TRIED]]


def _prepared(turns: Sequence[MappedTurn | Tracked], T_odom_base: FloatArray) -> PreparedMap:
    """The points of several turns in ``base`` of one of them, ready to be compared."""
    T_base = [se3.between(T_odom_base, each.T_odom_base) for each in turns]
    points = [se3.transform(T, each.points) for T, each in zip(T_base, turns, strict=True)]
    origins = [se3.transform(T, each.origin[None]) for T, each in zip(T_base, turns, strict=True)]
    joined = np.concatenate(points)
    kept = thinned(joined, _CELL_M)
    return PreparedMap(joined[kept], np.repeat(np.concatenate(origins), [len(each) for each in points], axis=0)[kept])


def wall_columns(local: VoxelMap) -> FloatArray:
    """Walls from above: the middles of columns that are occupied at several heights, in ``ground``, shape (K, 2)."""
    low_m, high_m, count = _HEIGHTS
    points = local.points_m
    height = np.floor((points[:, 2] - low_m) / (high_m - low_m) * count).astype(np.int64)
    inside = (height >= 0) & (height < count)
    cells = np.floor(points[inside, :2] / _COLUMN_M).astype(np.int64)
    seen = np.unique(np.column_stack((cells, height[inside])), axis=0)
    walls, heights = np.unique(seen[:, :2], axis=0, return_counts=True)
    return np.asarray((walls[heights >= _LEAST_HEIGHTS] + 0.5) * _COLUMN_M, np.float64)
