"""Converts the messages of a bag and checks them; invalid messages raise ValueError."""

from collections.abc import Iterator
from math import degrees, inf, isfinite, pi, radians
from typing import Any, NamedTuple

import numpy as np

from fcslam.records import Ranges, Transform
from fcslam.sources.bags.transforms import planar, transform_of
from fcslam.sources.pose import Pose

_LONGEST_RANGE_M = 1000.0
_FULL_TURN_RAD = 2.0 * pi + 0.1
_MAX_COORDINATE_M = 1e7
_NANOSECONDS = 10**9


class Beams(NamedTuple):
    """Directions of a scan's beams, counter-clockwise."""

    beam_count: int
    angle_min_rad: float
    angle_increment_rad: float

    @property
    def span_rad(self) -> float:
        """Angle between the first and the last beam."""
        return (self.beam_count - 1) * self.angle_increment_rad


class ScanMessage(NamedTuple):
    """sensor_msgs/LaserScan."""

    stamp: float
    frame: str
    beams: Beams
    range_min_m: float
    range_max_m: float
    raw_ranges_m: Ranges
    """Ranges as sent, metres, shape (beam_count,)."""

    @property
    def beam_count(self) -> int:
        """Ranges in the scan."""
        return self.beams.beam_count


class OdometryReading(NamedTuple):
    """One pose of the wheel odometry, from nav_msgs/Odometry or tf."""

    stamp: float
    T_odom_base: Pose
    base_frame: str


class StampedTransform(NamedTuple):
    """One transform of a tf message."""

    stamp: float
    parent: str
    child: str
    T_parent_child: Transform


def scan_of(content: Any, bag_time_ns: int) -> ScanMessage:
    """Convert a laser scan; clockwise beams are reversed."""
    ranges = np.asarray(content.ranges, dtype=np.float32)
    count = len(ranges)
    first_rad, increment_rad = _angle_rad(content.angle_min), _angle_rad(content.angle_increment)
    range_min_m, range_max_m = float(content.range_min), float(content.range_max)
    span_rad = (count - 1) * increment_rad
    if not (count >= 2 and abs(first_rad) <= _FULL_TURN_RAD and 0.0 < abs(span_rad) < _FULL_TURN_RAD):
        raise ValueError("no sane field of view")
    range_min_m = range_min_m if range_min_m > 0.0 else 0.0
    if not range_max_m > range_min_m:
        raise ValueError("no sane range")
    if increment_rad < 0.0:
        first_rad, increment_rad, ranges = first_rad + span_rad, -increment_rad, ranges[::-1]
    stamp, frame = header_of(content.header, bag_time_ns)
    beams = Beams(count, first_rad, increment_rad)
    return ScanMessage(stamp, frame, beams, range_min_m, min(range_max_m, _LONGEST_RANGE_M), ranges)


def measured_ranges(scan: ScanMessage) -> Ranges:
    """Ranges of a scan by REP 117, metres, shape (beam_count,).

    At or beyond the maximum: inf (no return). Below the minimum or not a number: NaN (invalid).
    """
    raw = scan.raw_ranges_m
    ranges: Ranges = np.where(raw >= np.float32(scan.range_max_m), np.float32(inf), raw)
    ranges[~(raw >= np.float32(scan.range_min_m))] = np.nan
    return ranges


def odometry_of(content: Any, bag_time_ns: int) -> OdometryReading:
    """Convert an odometry message; the base is its child frame."""
    stamp, _ = header_of(content.header, bag_time_ns)
    pose = content.pose.pose
    transform = _transform(pose.position, pose.orientation)
    return OdometryReading(stamp, planar(transform), _frame(content.child_frame_id))


def transforms_of(content: Any, bag_time_ns: int) -> Iterator[StampedTransform]:
    """The transforms of a tf message."""
    for entry in content.transforms:
        stamp, parent = header_of(entry.header, bag_time_ns)
        transform = _transform(entry.transform.translation, entry.transform.rotation)
        yield StampedTransform(stamp, parent, _frame(entry.child_frame_id), transform)


def _angle_rad(single: float) -> float:
    """Undo the rounding of an angle to single precision: most lasers have multiples of 0.0001 degrees."""
    rounded = radians(round(degrees(single), 4)) if isfinite(single) else single
    return rounded if np.float32(rounded) == np.float32(single) else float(single)


def header_of(header: Any, bag_time_ns: int) -> tuple[float, str]:
    """Stamp and frame of a header; a zero stamp is replaced by the time of recording."""
    stamp_ns = header.stamp.sec * _NANOSECONDS + header.stamp.nanosec
    return (stamp_ns or bag_time_ns) / _NANOSECONDS, _frame(header.frame_id)


def _frame(name: str) -> str:
    """Frame name without the leading slash of ROS 1."""
    return name.lstrip("/")


def _transform(translation: Any, rotation: Any) -> Transform:
    x, y, z = translation.x, translation.y, translation.z
    if not max(abs(x), abs(y), abs(z)) < _MAX_COORDINATE_M:
        raise ValueError("no sane position")
    if not all(map(isfinite, (x, y, z))):
        raise ValueError("no finite position")
    return transform_of((x, y, z), (rotation.x, rotation.y, rotation.z, rotation.w))
