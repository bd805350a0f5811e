"""The poses of a robot's scans in one session. They stay on the robot."""

from array import array
from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fcslam.geometry.groups import SE2, Group
from fcslam.lidar.frontend import ScanPose
from fcslam.records import FloatArray


class ScanBelief(NamedTuple):
    """How sure a front end is of the pose of its newest scan."""

    points: FloatArray | None
    """Information of the scan's points over x, y and more; None if the robot stands still."""
    covariance: Callable[[], FloatArray]
    """Gives the covariance of the motion since the last keyscan, in its tangent, shape (d, d)."""


class ScanTrack:
    """Each scan has a fixed offset to a keyscan, and each keyscan a pose in ``odom``, the frame of the session's first
    keyscan. It grows by 36 bytes a scan in the plane; ``P`` is 3 there, and 7 in space."""

    def __init__(self, floor: str = "", is_new_floor: bool = False, group: Group = SE2) -> None:
        self.floor = floor
        """Floor of the session; empty: it has no name."""
        self.is_new_floor = is_new_floor
        """Whether the robot came to the floor with this session; otherwise it was lost there."""
        self._stamps, self._keyscans, self._T_keyscan_base = array("d"), array("i"), array("d")
        self._T_odom_keyscan = array("d", group.identity)
        self._group, self._size = group, group.size

    def __len__(self) -> int:
        return len(self._stamps)

    def __iter__(self) -> Iterator[ScanPose]:
        return map(self.__getitem__, range(len(self)))

    def __getitem__(self, index: int) -> ScanPose:
        number = range(len(self))[index]
        offset = np.array(self._T_keyscan_base[self._size * number : self._size * (number + 1)])
        return ScanPose(self._stamps[number], self._keyscans[number], offset)

    def add(self, pose: ScanPose) -> None:
        """Append the pose of the next scan."""
        self._stamps.append(pose.stamp)
        self._keyscans.append(pose.keyscan)
        self._T_keyscan_base.extend(pose.T_keyscan_base.tolist())

    def cut(self, last_s: float) -> None:
        """Drop the newest scans, those after ``last_s``, seconds."""
        while self._stamps and self._stamps[-1] > last_s:
            self._stamps.pop()
            self._keyscans.pop()
            del self._T_keyscan_base[-self._size :]

    def extend(self, motion: FloatArray) -> None:
        """Append the next keyscan by the motion to it from the previous one, shape (P,), as it is sent to the cloud."""
        self._T_odom_keyscan.extend(self._group.compose(np.array(self._T_odom_keyscan[-self._size :]), motion))

    def in_odom(self, pose: ScanPose) -> FloatArray:
        """``T_odom_base`` of a scan whose keyscan is in this track, shape (P,), metres and radians."""
        return self._group.compose(self.keyscan_in_odom(pose.keyscan), pose.T_keyscan_base)

    def keyscan_in_odom(self, number: int) -> FloatArray:
        """Pose of a keyscan in ``odom``, shape (P,), metres and radians."""
        return np.array(self._T_odom_keyscan[self._size * number : self._size * (number + 1)])

    @property
    def stamps(self) -> FloatArray:
        """Stamp of each scan, shape (N,), seconds."""
        return np.array(self._stamps)

    @property
    def keyscans(self) -> NDArray[np.int64]:
        """Number of each scan's keyscan, shape (N,)."""
        return np.array(self._keyscans, dtype=np.int64)

    @property
    def T_keyscan_base(self) -> FloatArray:
        """Pose of each scan in its keyscan's base, shape (N, P), metres and radians."""
        return np.array(self._T_keyscan_base).reshape(-1, self._size)

    @property
    def T_odom_keyscan(self) -> FloatArray:
        """Pose of each keyscan in ``odom``, shape (K, P), metres and radians."""
        return np.array(self._T_odom_keyscan).reshape(-1, self._size)

    def T_odom_base(self) -> FloatArray:
        """Pose of each scan in ``odom``, shape (N, P), metres and radians."""
        return self._group.compose(self.T_odom_keyscan[self.keyscans], self.T_keyscan_base)
