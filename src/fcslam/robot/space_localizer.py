"""Localization of one robot in a finished map in space, which does not change.

In the plane, a robot with a 3D LiDAR is found and followed like one with a 2D laser (``map_localizer``): what such a
laser would see of its clouds is compared with the grid. Each keyframe is then registered to the surfaces of the map. A
robot with a 2D laser stands on the floor of the map.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import numpy as np
from scipy.spatial import cKDTree

from fcslam.geometry import se2, se3
from fcslam.geometry.groups import SE3
from fcslam.graph.evidence import AGREES_M, AGREES_RAD
from fcslam.lidar.frontend import MappedKeyscan
from fcslam.lidar.scan import keyscan_points
from fcslam.lidar3d.ground import levelled
from fcslam.lidar3d.local_maps import MappedTurn
from fcslam.lidar3d.surfels import SurfelMap
from fcslam.lidar3d.tracker import MOST_POINTS, fit_rigid, thinned
from fcslam.records import Constraint, ConstraintKind, FloatArray, Keyscan, frozen
from fcslam.robot.backend import NewKeyscan, Task
from fcslam.robot.frontend3d import RobotFrontend3d
from fcslam.robot.map_localizer import MapEstimate, MapLocalizer
from fcslam.sources.clouds_in_space import BAND_LASER, floor_at
from fcslam.wire.messages import Hello, Packet

_AT_ONCE: Final = 10_000
_UPWARD: Final = 0.9
"""Least z of the normal of a floor."""
_COLUMN_M, _FLOOR_M = 0.5, 0.15
"""The floor is the lowest that faces up in a column of this side, and what is at most so much higher there."""
_NEIGHBOURS, _AROUND_M = 20, 1.5
"""Points that give about the height of the floor, and the distance of those that give its inclination."""
_UP: Final = np.array([0.0, 0.0, 1.0])
_THINNED_M: Final = 0.2
_ON_SURFACE: Final = 0.7
"""Least share of the points near surfaces that are on them, for a registration that counts."""


class SpaceMap:
    """A finished map in space: its surfaces and its floor."""

    def __init__(self, points: FloatArray, normals: FloatArray) -> None:
        """``points`` (N, 3) and ``normals`` (N, 3), which face the scanner."""
        self.surfaces = SurfelMap()
        for start in range(0, len(points), _AT_ONCE):
            part = slice(start, start + _AT_ONCE)
            self.surfaces.add(points[part], -normals[part], 1.0 + start)
        upward = points[normals[:, 2] > _UPWARD]
        upward = upward if len(upward) else points
        _, column = np.unique(np.floor(upward[:, :2] / _COLUMN_M), axis=0, return_inverse=True)
        lowest = np.full(len(upward), np.inf)
        np.minimum.at(lowest, column.ravel(), upward[:, 2])
        self._floor = upward[upward[:, 2] < lowest[column.ravel()] + _FLOOR_M]
        self._near = cKDTree(self._floor[:, :2])

    def on_floor(self, pose: FloatArray, is_level: bool = False) -> FloatArray:
        """The pose (7,) at x, y and heading of what stands on the floor there; NaN for NaN."""
        if np.isnan(pose).any():
            return np.full(SE3.size, np.nan)
        standing = se3.from_plane(pose)
        nearest = self._near.query(pose[:2], range(1, 1 + min(_NEIGHBOURS, len(self._floor))))[1]
        standing[2] = np.median(self._floor[nearest, 2])
        around = self._floor[self._near.query_ball_point(pose[:2], _AROUND_M)]
        normal, off_m = floor_at(around - standing[:3]) or (_UP, 0.0)
        standing[2] += off_m / normal[2]
        return levelled(standing, _UP if is_level else normal, 0.0)


class SpaceLocalizer:
    """Localizes one robot with a 3D LiDAR by its keyframes."""

    def __init__(self, robot: RobotFrontend3d, plane: MapLocalizer, space: SpaceMap) -> None:
        self.estimate: MapEstimate | None = None
        """``T_map_odom`` in space, shape (7,), the rest in the plane; None while the robot is not localized."""
        self._robot, self._plane, self._space = robot, plane, space
        self._T_level_odom: FloatArray | None = None
        """In ``level``, the first keyframe of the session stands level at the origin."""
        self._before: FloatArray | None = None

    def follow(self, packets: Sequence[Packet]) -> None:
        """Take what the front end made of the next record."""
        bodies = [packet.body for packet in packets]
        if any(isinstance(body, Hello) for body in bodies) and self._T_level_odom is not None:
            self._plane.submit(Task.END_SESSION)
            self._T_level_odom = self._before = self.estimate = None
        keyscan = next((body for body in bodies if isinstance(body, Keyscan)), None)
        if keyscan is not None and self._robot.mapped is not None:
            moved = (body for body in bodies if isinstance(body, Constraint) and body.kind is ConstraintKind.ODOMETRY)
            self._add(keyscan, next(moved, None), *self._robot.mapped)

    def _add(
        self, keyscan: Keyscan, motion: Constraint | None, keyframe: MappedTurn, T_odom_ground: FloatArray
    ) -> None:
        if self._T_level_odom is None:
            self._T_level_odom = se3.inverse(T_odom_ground)
        T_level_ground = SE3.to_plane(se3.compose(self._T_level_odom, T_odom_ground))
        if motion is not None and self._before is not None:
            moved, information = se2.between(self._before, T_level_ground), SE3.planar_information(motion.information)
            motion = replace(motion, T_i_j=frozen(moved), information=frozen(information))
        self._before = T_level_ground
        points = keyscan_points(keyscan, (BAND_LASER,))
        seen = MappedKeyscan(keyscan, motion, points, T_level_ground, T_level_ground, keyframe.travel_m)
        self._plane.submit(NewKeyscan(seen, (BAND_LASER,)))
        planar = self._plane.estimate
        if planar is None:
            self.estimate = None
            return
        guess = self._guess(se2.compose(planar.T_map_odom, T_level_ground), keyframe.T_odom_base, T_odom_ground)
        chosen = keyframe.points[thinned(keyframe.points, _THINNED_M, MOST_POINTS)]
        found, _, on_surface, near = fit_rigid(self._space.surfaces, chosen, guess)
        T_map_base = found if near and on_surface > _ON_SURFACE * near else guess
        self.estimate = replace(planar, T_map_odom=frozen(se3.compose(T_map_base, se3.inverse(keyframe.T_odom_base))))

    def _guess(self, planar: FloatArray, T_odom_base: FloatArray, T_odom_ground: FloatArray) -> FloatArray:
        """``T_map_base`` whose ground is where the plane says, and as high and inclined as before."""
        lifted = se3.compose(self._space.on_floor(planar, is_level=True), se3.between(T_odom_ground, T_odom_base))
        if self.estimate is None:
            return lifted
        ground = SE3.to_plane(se3.compose(self.estimate.T_map_odom, T_odom_ground))
        off = se2.between(ground, planar)
        if np.hypot(*off[:2]) > AGREES_M or abs(off[2]) > AGREES_RAD:
            return lifted
        corrected = se3.from_plane(se2.compose(planar, se2.inverse(ground)))
        return se3.compose(corrected, se3.compose(self.estimate.T_map_odom, T_odom_base))
