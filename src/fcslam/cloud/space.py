"""A fleet in space: what is measured in the plane becomes poses with six degrees of freedom, and is verified there.

The plane of a keyscan is its frame ``ground``: level, on the floor below its base. For robots that send voxel maps
``T_base_ground`` says where it is; for others it is their base. In a fleet in the plane nothing changes here.
"""

from dataclasses import replace
from functools import lru_cache
from typing import Final

import numpy as np

from fcslam.cloud.session_store import SessionStore
from fcslam.errors import PacketError
from fcslam.geometry import se3
from fcslam.geometry.groups import SE2, SE3, Group
from fcslam.lidar.scan import PointScan
from fcslam.lidar3d.voxel_matching import PreparedMap, align_maps, disagreement, prepared, seen_through
from fcslam.places.matcher import PlaceMatch
from fcslam.records import ClosureStatus, Constraint, FloatArray, KeyscanId, Reason, ReasonCode, frozen

_FLOOR_M, _FLOOR_RAD = 0.05, 0.02
"""Standard deviations of height and inclination of a floor that two robots saw at one place."""
_STEP_M, _STEP_RAD = 0.005, 0.003
"""The same of a robot's motion in the plane between two keyscans, beside a share of its length."""
_SLOPE: Final = 0.02
_NEAR_M, _NEAR_RAD = 0.6, 0.15
"""Farthest that the alignment of two voxel maps may be from where walls in the plane put them."""
_MOST_COMPARED, _SAME_PLACE_M = 16, 3.0
"""About how many places of two robots are compared for a join, and how near their voxel maps are."""
_KEPT: Final = 60
"""Voxel maps that are kept ready to compare, 3 MB each."""


class Space:
    """Lifts the measurements of a fleet to the group of its poses."""

    def __init__(self, group: Group, sessions: SessionStore) -> None:
        self.group, self._sessions = group, sessions
        self._ready = lru_cache(_KEPT)(self._prepared)

    def constraint(self, constraint: Constraint) -> Constraint:
        """A robot's constraint as one of the fleet's group."""
        is_planar = len(constraint.T_i_j) == SE2.size
        if self.group is SE2:
            if not is_planar:
                raise PacketError(f"{constraint.robot}: sends poses in space, but the mission is in the plane")
            return constraint
        if not is_planar:
            return constraint
        length_m = float(np.hypot(*constraint.T_i_j[:2]))
        information = _lifted(constraint.information, _STEP_M + _SLOPE * length_m, _STEP_RAD + _SLOPE * length_m)
        return replace(constraint, T_i_j=frozen(se3.from_plane(constraint.T_i_j)), information=frozen(information))

    def in_plane(self, T_i_j: FloatArray, i: KeyscanId, j: KeyscanId) -> FloatArray:
        """A motion between two keyscans as (x, y, theta) between their planes, shape (3,)."""
        if self.group is SE2:
            return T_i_j
        return SE3.to_plane(se3.compose(se3.inverse(self._ground(i)), se3.compose(T_i_j, self._ground(j))))

    def scans(self, anchor: KeyscanId, first: int, T_odom_base: FloatArray) -> list[tuple[PointScan, FloatArray]]:
        """Points of the keyscans from ``first`` on that are left, and their poses (3,) in the plane of one of them.

        ``T_odom_base`` (N, P) is that of all of them.
        """
        T_odom_anchor, numbers = T_odom_base[anchor.number - first], range(first, first + len(T_odom_base))
        if self.group is not SE2:
            T_odom_anchor = se3.compose(T_odom_anchor, self._ground(anchor))
        poses = self.group.to_plane(self.group.between(T_odom_anchor, T_odom_base))
        left = self._sessions.numbers(anchor.robot, numbers[0], numbers[-1]).tolist()
        return [(self._sessions.scan(anchor.robot, number), poses[number - first]) for number in left]

    def measured(
        self, i: KeyscanId, j: KeyscanId, T_i_j: FloatArray, information: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """A motion between the planes of two keyscans, and its information, in the fleet's group; floors are level."""
        if self.group is SE2:
            return T_i_j, information
        return self._of_bases(i, j, se3.from_plane(T_i_j), _lifted(information, _FLOOR_M, _FLOOR_RAD))

    def match(self, match: PlaceMatch) -> PlaceMatch:
        """A comparison of two places in the fleet's group; where both have voxel maps, these decide, too."""
        if self.group is SE2:
            return match
        T_i_j, information = self.measured(match.i, match.j, match.T_i_j, match.information)
        lifted = replace(match, T_i_j=frozen(T_i_j), information=frozen(information))
        voxels_a, voxels_b = self._sessions.voxel_map(match.i), self._sessions.voxel_map(match.j)
        if not match.M or voxels_a is None or voxels_b is None:
            return lifted
        a, b, guess = self._ready(match.i), self._ready(match.j), se3.from_plane(match.T_i_j)
        T_a_b, information = align_maps(a, b, guess)
        off = se3.between(guess, T_a_b)
        reason = _too_far(off) or disagreement(a, b, T_a_b, match.predicted)
        if reason is not None:
            return replace(lifted, status=ClosureStatus.CANDIDATE, reason=reason)
        T_i_j, information = self._of_bases(match.i, match.j, T_a_b, information)
        return replace(lifted, T_i_j=frozen(T_i_j), information=frozen(information))

    def seen_through(
        self, sessions: tuple[str, str], poses_a: FloatArray, poses_b: FloatArray, T_a_b: FloatArray
    ) -> float:
        """The share of surfaces that the other of two robots saw through, less its standard error between places.

        ``T_a_b`` (N, P) is between the frames of the poses of both at each of the N keyscans of b; NaN: not known.
        0.0 if a robot has no voxel maps. Furniture tells floors apart whose walls are the same.
        """
        if self.group is SE2:
            return 0.0
        a, b = map(self._sessions.voxel_maps, sessions)
        b = tuple(voxels for voxels in b if np.isfinite(T_a_b[voxels.id.number, 0]))
        if not a or not b:
            return 0.0
        grounds_a = np.array([se3.compose(poses_a[voxels.id.number], voxels.T_base_ground) for voxels in a])
        counts = []
        for new in b[:: 1 + len(b) // _MOST_COMPARED]:
            number = new.id.number
            between = se3.between(
                grounds_a, se3.compose(se3.compose(T_a_b[number], poses_b[number]), new.T_base_ground)
            )
            nearest = int(np.argmin(SE3.shift_m(between)))
            T = between[nearest]
            if SE3.shift_m(T) < _SAME_PLACE_M:
                maps = self._ready(a[nearest].id), self._ready(new.id)
                aligned, _ = align_maps(*maps, T)
                T = T if _too_far(se3.between(T, aligned)) else aligned
                counts.append(np.add(seen_through(*maps[::-1], T), seen_through(*maps, se3.inverse(T))))
        if len(counts) < 2:
            return 0.0
        known, through = np.array(counts).T
        share = float(through.sum() / max(1, known.sum()))
        spread = np.sqrt(((through - share * known) ** 2).sum() * len(counts) / (len(counts) - 1))
        return max(0.0, share - float(spread / max(1, known.sum())))

    def _of_bases(
        self, i: KeyscanId, j: KeyscanId, T_a_b: FloatArray, information: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """A motion between two frames ``ground`` as one between the bases."""
        T_b_j = se3.inverse(self._ground(j))
        moved = se3.adjoint(T_b_j)  # a step d of j is the step Ad d of b
        T_i_j = se3.compose(se3.compose(self._ground(i), T_a_b), T_b_j)
        turned = moved.T @ information @ moved
        return T_i_j, 0.5 * (turned + turned.T)

    def _prepared(self, keyscan: KeyscanId) -> PreparedMap:
        voxels = self._sessions.voxel_map(keyscan)
        assert voxels is not None
        return prepared(voxels)

    def _ground(self, keyscan: KeyscanId) -> FloatArray:
        voxels = self._sessions.voxel_map(keyscan)
        return se3.IDENTITY if voxels is None else voxels.T_base_ground


def _lifted(information: FloatArray, sigma_m: float, sigma_rad: float) -> FloatArray:
    """Information (6, 6) of one over x, y and heading, with these deviations of height, roll and pitch."""
    lifted = np.diag([0.0, 0.0, sigma_m**-2, sigma_rad**-2, sigma_rad**-2, 0.0])
    lifted[np.ix_((0, 1, 5), (0, 1, 5))] = information
    return lifted


def _too_far(off: FloatArray) -> Reason | None:
    if (off_m := float(SE3.shift_m(off))) > _NEAR_M:
        return Reason(ReasonCode.ASYMMETRIC, off_m, _NEAR_M)
    off_rad = float(SE3.turn_rad(off))
    return Reason(ReasonCode.ASYMMETRIC, off_rad, _NEAR_RAD) if off_rad > _NEAR_RAD else None
