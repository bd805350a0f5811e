"""The tree of transforms (tf) of a bag, and the mounting of the laser in it."""

from collections import deque
from collections.abc import Iterator
from itertools import pairwise
from math import acos, atan2, cos, isfinite, pi, radians, sin, sqrt
from typing import NamedTuple

import numpy as np

from fcslam.errors import FcslamError
from fcslam.geometry import se3
from fcslam.records import FloatArray, Transform
from fcslam.sources.pose import Pose

_STILL = 0.01
"""Largest difference between the messages of a fixed transform, in metres or quaternion units."""
_LARGEST_SWAY_RAD = radians(20.0)
"""A body leans less on its wheels or legs; a laser that nods leans more."""


class NoTransformError(FcslamError):
    """Two frames are not connected by fixed transforms; the message says which."""


class Mounting(NamedTuple):
    """Mounting of a laser on its robot, seen from above."""

    T_base_laser: Pose
    upside_down: bool
    tilt_rad: float
    """Angle between the laser's plane and the floor, 0 to pi / 2."""


Link = tuple[str, str]
"""Names of the parent and the child of a transform."""
USUAL_BASES = ("base_footprint", "base_link")
"""Frames of the robot's body, where no message names it."""
_CORRECTED = ("map", "world", "earth", "utm", "global", "camera_init")
"""Parts of the names of frames, besides odometry's, in which a robot drives and jumps; the last: LOAM's successors."""
_NO_ODOMETRY = ("map", *USUAL_BASES)
"""Frames in which a robot jumps, or in which its joints move."""
IDENTITY = Transform((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))


def transform_of(translation_m: tuple[float, float, float], rotation: tuple[float, float, float, float]) -> Transform:
    """Check a transform and normalise its quaternion (x, y, z, w); raises ValueError if it is invalid."""
    x, y, z, w = rotation
    length = sqrt(x * x + y * y + z * z + w * w)
    if not abs(length - 1.0) < 0.1:
        raise ValueError(f"the orientation {x:g}, {y:g}, {z:g}, {w:g} is not a unit quaternion")
    if not all(map(isfinite, translation_m)):
        raise ValueError("the translation is not finite")
    return Transform(translation_m, (x / length, y / length, z / length, w / length))


def planar(transform: Transform) -> Pose:
    """Project to the floor: x, y, and the heading of the x axis, rounded to 1 nrad to remove rounding noise."""
    x, y, z, w = transform.rotation
    heading_rad = atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
    return transform.translation_m[0], transform.translation_m[1], round(heading_rad, 9)


def in_space(pose: FloatArray) -> Transform:
    """A pose in three dimensions: one on the floor, shape (3,), or in space, shape (7,)."""
    if len(pose) == se3.IDENTITY.size:
        return Transform(tuple(pose[:3].tolist()), tuple(pose[3:].tolist()))
    x, y, heading_rad = pose.tolist()
    return Transform((x, y, 0.0), (0.0, 0.0, sin(0.5 * heading_rad), cos(0.5 * heading_rad)))


def mounting(T_base_laser: Transform) -> Mounting:
    """Mounting of a laser with this pose: planar pose, orientation and tilt."""
    up = min(1.0, max(-1.0, float(T_base_laser.rotation_matrix()[2, 2])))
    lean_rad = acos(up)
    return Mounting(planar(T_base_laser), up < 0.0, min(lean_rad, pi - lean_rad))


class TransformTree:
    """The frames and transforms seen so far."""

    def __init__(self) -> None:
        self._parents: dict[str, list[str]] = {}
        """Parents of each frame, in the order in which they appeared; usually one."""
        self.links: dict[Link, Transform | None] = {}
        """The first transform of each link, in the order in which they appeared; None if it moves."""

    def add(self, parent: str, child: str, T_parent_child: Transform) -> None:
        """Add a transform. The first one counts, level if it sways; a link whose transform moves later is moving."""
        if (parent, child) not in self.links:
            self._parents.setdefault(child, []).append(parent)
        of_link = self.links.setdefault((parent, child), T_parent_child)
        if of_link is not None and (differs := difference(of_link, T_parent_child)):
            level = of_link._replace(rotation=in_space(np.array(planar(of_link))).rotation)
            self.links[parent, child] = level if differs == 1 else None

    def __contains__(self, frame: str) -> bool:
        return frame in self._parents or any(parent == frame for parent, _ in self.links)

    @property
    def usual_base(self) -> str:
        """A usual frame of the robot's body, one that is there if there is any."""
        return next((frame for frame in USUAL_BASES if frame in self), USUAL_BASES[-1])

    def fixed(self, base: str, frame: str) -> Transform:
        """``T_base_frame`` along the shortest way."""
        way = self._way(base, frame, is_fixed_only=True)
        if way is None:
            moving = self._way(base, frame, is_fixed_only=False)
            if moving is None:
                raise NoTransformError(f"no transform from '{base}' to '{frame}'")
            pairs = (pair for at in pairwise(moving) for pair in (at, at[::-1]))
            parent, child = next(pair for pair in pairs if self.links.get(pair, IDENTITY) is None)
            raise NoTransformError(f"no fixed transform from '{base}' to '{frame}' ('{child}' moves in '{parent}')")
        pose = se3.IDENTITY
        for at, to in pairwise(way):
            step = self.links.get((at, to)) or self.links.get((to, at)) or IDENTITY
            T_at_to = (*step.translation_m, *step.rotation)
            pose = se3.compose(pose, T_at_to if (at, to) in self.links else se3.inverse(T_at_to))
        x, y, z, *rotation = pose.tolist()
        return Transform((x, y, z), tuple(rotation))

    def _way(self, base: str, frame: str, is_fixed_only: bool) -> list[str] | None:
        """The frames on the shortest way, with both ends."""
        beside: dict[str, list[str]] = {}
        for (parent, child), T_parent_child in self.links.items():
            if T_parent_child is not None or not is_fixed_only:
                beside.setdefault(parent, []).append(child)
                beside.setdefault(child, []).append(parent)
        seen, ways = {base}, deque([[base]])
        while ways:
            way = ways.popleft()
            if way[-1] == frame:
                return way
            for near in beside.get(way[-1], ()):
                if near not in seen:
                    seen.add(near)
                    ways.append([*way, near])
        return None

    def robot(self, frame: str, odom_frame: str | None = None, base_frame: str | None = None) -> Link:
        """The transform in which the robot with ``frame`` moves: its parent and child.

        On the way up from ``frame``, it is the first whose parent has "odom" in its name. Without one, it is the first
        that moves and is neither a joint of the robot nor its pose in a map. The parent is empty if none fits; the
        child is then the last frame to which ``frame`` is fixed. ``odom_frame`` and ``base_frame`` name the parent and
        the child; None: any.
        """
        above = [link for child in self._above(frame) for link in self.links if link[1] == child]
        above = [link for link in above if _matches(link, odom_frame, base_frame)]
        moves = [link for link in above if self.links[link] is None]
        sure = [*moves, *(link for link in above if len(self._parents[link[1]]) == 1)]
        named = [link for link in sure if is_odom(link[0])]
        moving = [link for link in moves if last_part(link[0]) not in _NO_ODOMETRY]
        ends = {child for _, child in moves}
        fixed = (each for each in self._above(frame) if each in ends or each not in self._parents)
        return next(iter((*named, *moving, *(above if odom_frame else ()))), ("", next(fixed, frame)))

    def odometry_link(self, frame: str, odom_frame: str | None = None, base_frame: str | None = None) -> Link | None:
        """The transform that is the odometry of the robot with ``frame``; None without one.

        It is that of ``robot``, else from "odom" to a usual base. If tf lacks ``frame``, it is the first that can be.
        """
        link = self.robot(frame, odom_frame, base_frame)
        if link[0]:
            return link
        unconnected = [] if frame in self else self.links
        if odom_frame or base_frame:
            return next((each for each in unconnected if _matches(each, odom_frame, base_frame)), None)
        bases = (each for each in self.links if is_odom(each[0]) and last_part(each[1]) in USUAL_BASES)
        return next(bases, next((each for each in unconnected if is_odom(each[0])), None))

    def _above(self, frame: str) -> Iterator[str]:
        """The frame and its ancestors, of several parents by one that has parents; a cycle ends where it closes."""
        seen: set[str] = set()
        while frame not in seen:
            seen.add(frame)
            yield frame
            parents = self._parents.get(frame, [frame])
            frame = next((parent for parent in parents if parent in self._parents), parents[0])


def last_part(name: str) -> str:
    """The name of a topic or a frame without its namespace."""
    return name.rsplit("/", 1)[-1]


def is_odom(frame: str) -> bool:
    """Whether odometry is usually in a frame of this name."""
    return "odom" in last_part(frame)


def is_corrected(frame: str) -> bool:
    """Whether poses in a frame of this name are corrected, and jump."""
    return any(name in last_part(frame) for name in _CORRECTED) and not is_odom(frame)


def _matches(link: Link, parent: str | None, child: str | None) -> bool:
    return parent in (None, link[0]) and child in (None, link[1])


def difference(first: Transform, second: Transform) -> int:
    """How two transforms differ by more than noise: 0 not; 1 in height, roll or pitch, as a body sways; 2 otherwise.

    q and -q are the same rotation.
    """
    apart = max(abs(a - b) for a, b in zip(first.translation_m, second.translation_m, strict=True))
    alike = abs(sum(a * b for a, b in zip(first.rotation, second.rotation, strict=True)))
    if apart <= _STILL and alike >= 1.0 - _STILL * _STILL:
        return 0
    (x, y, heading_rad), (other_x, other_y, other_rad) = planar(first), planar(second)
    is_same = max(abs(x - other_x), abs(y - other_y)) <= _STILL and cos(heading_rad - other_rad) > cos(2.0 * _STILL)
    is_upright = all(each.rotation_matrix()[2, 2] > cos(_LARGEST_SWAY_RAD) for each in (first, second))
    return 1 if is_same and is_upright else 2
