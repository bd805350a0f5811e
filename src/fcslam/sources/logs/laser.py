"""The laser geometry of a log, which old logs do not state.

A geometry stated in a scan line (ROBOTLASER1) is used. Otherwise the beam count decides:

- parameters ``laser_front_laser_resolution`` and ``laser_front_laser_fov`` where both are there and fit the count, or
  ``laser_front_laser_fov`` alone;
- 101, 201 and 401 beams are a SICK that looks over 100 degrees, 541 and 1081 a scanner that looks over 270 degrees;
- any other count spans 180 degrees: 180 beams are 1 degree apart (-90 .. +89), 181 too (-90 .. +90), 360 and 361
  are 0.5 degrees apart.

In all of them beam ``n // 2`` looks straight ahead.

A range of 50 m or more is not a return. SICK scanners send 81.8 to 81.9 m, about 51.2 m or 50 m for it, depending on
their resolution, and logs do not say which; beyond 50 m indoors nothing is lost. The parameter
``robot_front_laser_max`` does not help: it belongs to obstacle avoidance, and a log with 10 m has good returns at 12 m.
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from math import degrees, isfinite, radians

from fcslam.records import Beams, LaserModel
from fcslam.sources.gate import TOLERATED_SHARE, usual_beams
from fcslam.sources.logs.carmen import SICK_MAX_RANGE_M, ScanLine
from fcslam.sources.pose import Pose, relative_pose

_MOUNTING_TOLERANCE = 0.01
"""Largest difference between the mountings of two scans, in metres or radians."""
_FULL_TURN_DEG = 360.0
_RESOLUTION_DEG = {101: 1.0, 201: 0.5, 401: 0.25, 541: 0.5, 1081: 0.25}


def usual_log_beams(scans: Sequence[ScanLine], parameters: Mapping[str, str]) -> Beams:
    """The usual beams of the first scans of a log."""
    stated = [scan.stated.beams for scan in scans if scan.stated is not None]
    if stated:
        return usual_beams(stated)
    (count, _), *_ = Counter(len(scan.ranges_m) for scan in scans).most_common(1)
    return assumed_laser(count, parameters).beams


def beams_of(scan: ScanLine, declared: Beams) -> Beams | None:
    """The beams that the line states, or those of the laser; None if there are more or fewer and no angles."""
    if scan.stated is not None:
        return scan.stated.beams
    return declared if len(scan.ranges_m) == declared.beam_count else None


class MountingEstimate:
    """Estimates the mounting of the laser from the two poses of every scan."""

    def __init__(self) -> None:
        self._count = 0
        self._first: Pose | None = None
        self._differing = 0

    def add(self, scan: ScanLine) -> None:
        """Add one scan."""
        pose = (0.0, 0.0, 0.0)
        if scan.T_odom_laser != scan.T_odom_base:
            pose = relative_pose(scan.T_odom_base, scan.T_odom_laser)
        self._count += 1
        self._first = self._first or pose
        if pose != self._first and max(map(abs, relative_pose(self._first, pose))) > _MOUNTING_TOLERANCE:
            self._differing += 1

    def T_base_laser(self, offset_m: float) -> Pose:
        """The mounting on which the scans agree, rounded to 0.1 mm; otherwise ``offset_m`` ahead of the base.

        Scans disagree if only one of their poses was corrected. They contain no mounting if both poses are equal.
        """
        assert self._first is not None
        agreed = tuple(round(value, 4) + 0.0 for value in self._first)
        if self._differing > TOLERATED_SHARE * self._count or not any(agreed):
            return (offset_m, 0.0, 0.0)
        return agreed[0], agreed[1], agreed[2]


def laser_model(scan: ScanLine, parameters: Mapping[str, str], mounting: MountingEstimate) -> LaserModel:
    """The laser of ``scan``."""
    T_base_laser = mounting.T_base_laser(_parameter(parameters, "robot_frontlaser_offset") or 0.0)
    stated = scan.stated or assumed_laser(len(scan.ranges_m), parameters)
    return replace(stated, T_base_laser=T_base_laser)


def assumed_laser(beam_count: int, parameters: Mapping[str, str] | None = None) -> LaserModel:
    """The default geometry of a laser with ``beam_count`` (two or more) beams."""
    middle = beam_count // 2
    resolution_deg = _parameter_resolution_deg(beam_count, parameters or {})
    if resolution_deg is None:
        resolution_deg = _RESOLUTION_DEG.get(beam_count, 90.0 / middle)
    increment_rad = radians(resolution_deg)
    return LaserModel(beam_count, -middle * increment_rad, increment_rad, SICK_MAX_RANGE_M)


def _parameter_resolution_deg(beam_count: int, parameters: Mapping[str, str]) -> float | None:
    resolution_deg = _parameter(parameters, "laser_front_laser_resolution")
    fov = _parameter(parameters, "laser_front_laser_fov")
    if fov is None or fov <= 0.0:
        return None
    fov_deg = degrees(fov) if fov < 7.0 else fov
    if resolution_deg is None and fov_deg < _FULL_TURN_DEG + 1.0:
        return fov_deg / (beam_count - (fov_deg < _FULL_TURN_DEG - 1.0))
    if resolution_deg is None or resolution_deg <= 0.0:
        return None
    fits = abs((beam_count - 1) * resolution_deg - fov_deg) < 1.5 * resolution_deg
    return resolution_deg if fits else None


def _parameter(parameters: Mapping[str, str], name: str) -> float | None:
    try:
        value = float(parameters[name])
    except (KeyError, ValueError):
        return None
    return value if isfinite(value) else None
