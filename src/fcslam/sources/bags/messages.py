"""Converts the messages of a bag and checks them; invalid messages raise ValueError."""

from collections.abc import Callable, Iterator
from math import degrees, isfinite, nan, radians, remainder
from typing import Any, NamedTuple

import numpy as np

from fcslam.geometry.beams import FULL_TURN_RAD, ROUNDING, SAME_VIEW_BEAMS, is_field_of_view
from fcslam.records import Beams, Ranges, Sweep, Transform
from fcslam.sources.bags.codec import NANOSECONDS
from fcslam.sources.bags.transforms import planar, transform_of
from fcslam.sources.pose import LARGEST_COORDINATE, Pose

UNKNOWN_RANGE_M = 1000.0
"""Taken as the maximum of a laser that states none: 0, below 0 or not a number; and of one that states more."""
SHORTEST_SWEEP_S, LONGEST_SWEEP_S = 1e-4, 2.5
"""A scan that takes less is one at once; no scanner takes longer for a turn, so a larger time increment is wrong."""
LONGEST_NAME = 255
"""Characters in the name of a topic or a frame, as in ROS 2."""


class ScanMessage(NamedTuple):
    """sensor_msgs/LaserScan, or the first echoes of sensor_msgs/MultiEchoLaserScan."""

    stamp: float
    frame: str
    beams: Beams
    """Counter-clockwise."""
    range_min_m: float
    range_max_m: float
    raw_ranges_m: Ranges
    """Ranges as sent, metres, shape (beam_count,)."""
    laser: int = 0
    sweep: Sweep | None = None
    """Times of the beams, without a motion; None: all were measured at the stamp, or nothing is known."""
    ranges_at_stamp: Callable[[Sweep], Ranges] | None = None
    """The ranges from where the robot is at the stamp, if the beams were measured in no order, given the motion."""

    @property
    def end(self) -> float:
        """Stamp of its last measurement."""
        return self.stamp + self.duration_s

    @property
    def duration_s(self) -> float:
        """Time from the stamp to the last measurement."""
        return 0.0 if self.sweep is None else max(self.sweep.first_s, self.sweep.last_s)


class OdometryReading(NamedTuple):
    """One pose of the wheel odometry, from nav_msgs/Odometry or tf."""

    stamp: float
    T_odom_base: Pose
    base_frame: str
    odom_frame: str


class StampedTransform(NamedTuple):
    """One transform of a tf message."""

    stamp: float
    parent: str
    child: str
    T_parent_child: Transform


def scan_of(content: Any, bag_time_ns: int) -> ScanMessage:
    """Convert a laser scan, or the first echoes of one with several; clockwise beams are reversed."""
    ranges = _first_echoes(content.ranges)
    count = len(ranges)
    first_rad, increment_rad = _angle_rad(content.angle_min), _angle_rad(content.angle_increment)
    range_min_m, range_max_m = float(content.range_min), float(content.range_max)
    _check_angles(count, first_rad, increment_rad, float(content.angle_max))
    span_rad = (count - 1) * increment_rad
    range_min_m = range_min_m if range_min_m > 0.0 else 0.0
    range_max_m = min(range_max_m, UNKNOWN_RANGE_M) if range_max_m > 0.0 else UNKNOWN_RANGE_M
    if not range_max_m > range_min_m:
        raise ValueError(f"range_min {range_min_m:g} is not below range_max {range_max_m:g}")
    last_s = (count - 1) * float(content.time_increment)  # the stamp is the time of the first, as LaserScan.msg says
    sweep = Sweep(0.0, last_s) if SHORTEST_SWEEP_S <= last_s <= LONGEST_SWEEP_S else None  # NaN is in no interval
    if increment_rad < 0.0:
        first_rad, increment_rad, ranges = first_rad + span_rad, -increment_rad, ranges[::-1]
        sweep = reversed_sweep(sweep)
    if abs(first_rad) > FULL_TURN_RAD:
        first_rad = remainder(first_rad, FULL_TURN_RAD)
    stamp, frame = header_of(content.header, bag_time_ns)
    beams = Beams(count, first_rad, increment_rad)
    return ScanMessage(stamp, frame, beams, range_min_m, range_max_m, ranges, sweep=sweep)


def reversed_sweep(sweep: Sweep | None) -> Sweep | None:
    """The times of the beams in the opposite order."""
    return None if sweep is None else sweep._replace(first_s=sweep.last_s, last_s=sweep.first_s)


def _first_echoes(ranges: Any) -> Ranges:
    """The ranges of sensor_msgs/LaserScan as they are; of MultiEchoLaserScan the nearest, NaN without an echo."""
    if len(ranges) and hasattr(ranges[0], "echoes"):
        ranges = [beam.echoes[0] if len(beam.echoes) else nan for beam in ranges]
    return np.asarray(ranges, dtype=np.float32)


def _check_angles(count: int, first_rad: float, increment_rad: float, last_rad: float) -> None:
    """Refuse angles that leave open where the beams look. One range more or less is usual, as drivers count in
    different ways whether a full turn includes the first direction again."""
    if not all(map(isfinite, (first_rad, increment_rad, last_rad))):
        raise ValueError("an angle is not finite")
    if increment_rad == 0.0:
        raise ValueError("angle_increment is 0")
    if abs(first_rad) > 1.01 * FULL_TURN_RAD or not is_field_of_view(Beams(count, 0.0, increment_rad)):
        is_degrees = is_field_of_view(Beams(count, radians(first_rad), radians(increment_rad)))
        remedy = ", as if in degrees: publish radians" * is_degrees
        raise ValueError(
            f"{count} ranges from angle_min {first_rad:g} by {increment_rad:g} rad have no field of view{remedy}"
        )
    stated = (last_rad - first_rad) / increment_rad + 1.0
    if stated < 1.0:
        raise ValueError("angle_increment leads away from angle_max")
    if abs(stated - count) > max(SAME_VIEW_BEAMS, ROUNDING * count):
        raise ValueError(f"{count} ranges, but the angles are those of {stated:.0f}")


def measured_ranges(scan: ScanMessage) -> Ranges:
    """Ranges of a scan by REP 117, metres, shape (beam_count,).

    inf: no return. A number that is not between the limits: NaN (invalid). Drivers that send the maximum, or more,
    for no return send it for faults, too.
    """
    raw = scan.raw_ranges_m
    is_known = (raw >= np.float32(scan.range_min_m)) & (raw < np.float32(scan.range_max_m)) | np.isposinf(raw)
    return np.where(is_known, raw, np.float32(nan))


def odometry_of(content: Any, bag_time_ns: int) -> OdometryReading:
    """Convert an odometry message; the base is its child frame."""
    stamp, odom_frame = header_of(content.header, bag_time_ns)
    pose = content.pose.pose
    transform = _transform(pose.position, pose.orientation)
    return OdometryReading(stamp, planar(transform), frame_of(content.child_frame_id), odom_frame)


def transforms_of(content: Any, bag_time_ns: int) -> Iterator[StampedTransform]:
    """The transforms of a tf message."""
    for entry in content.transforms:
        stamp, parent = header_of(entry.header, bag_time_ns)
        transform = _transform(entry.transform.translation, entry.transform.rotation)
        yield StampedTransform(stamp, parent, frame_of(entry.child_frame_id), transform)


def odometry_in(transform: StampedTransform) -> OdometryReading:
    """The reading that a transform from odom to base is."""
    return OdometryReading(transform.stamp, planar(transform.T_parent_child), transform.child, transform.parent)


def _angle_rad(single: float) -> float:
    """Undo the rounding of an angle to single precision: most lasers have multiples of 0.0001 degrees."""
    rounded = radians(round(degrees(single), 4)) if isfinite(single) else single
    return rounded if np.float32(rounded) == np.float32(single) else float(single)


def header_of(header: Any, bag_time_ns: int) -> tuple[float, str]:
    """Stamp and frame of a header; a zero stamp is replaced by the time of recording."""
    return (stamp_ns_of(header) or bag_time_ns) / NANOSECONDS, frame_of(header.frame_id)


def stamp_ns_of(header: Any) -> int:
    """The stamp of a header."""
    return int(header.stamp.sec * NANOSECONDS + header.stamp.nanosec)


def frame_of(name: str) -> str:
    """Frame name without the leading slash of ROS 1."""
    if len(name) > LONGEST_NAME:
        raise ValueError("the name of a frame is too long")
    return name.lstrip("/")


def _transform(translation: Any, rotation: Any) -> Transform:
    x, y, z = translation.x, translation.y, translation.z
    if not all(abs(value) < LARGEST_COORDINATE for value in (x, y, z)):  # false for NaN
        raise ValueError(f"the position {x:g}, {y:g}, {z:g} cannot be that of a robot")
    return transform_of((x, y, z), (rotation.x, rotation.y, rotation.z, rotation.w))
