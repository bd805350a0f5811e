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

import numpy as np

from fcslam.geometry import se2
from fcslam.records import Beams, LaserModel
from fcslam.sources.gate import TOLERATED_SHARE, usual_beams
from fcslam.sources.logs.carmen import SICK_MAX_RANGE_M, CarmenArrays

_MOUNTING_TOLERANCE = 0.01
"""Largest difference between the mountings of two scans, in metres or radians."""
_FULL_TURN_DEG = 360.0
_RESOLUTION_DEG = {101: 1.0, 201: 0.5, 401: 0.25, 541: 0.5, 1081: 0.25}


def usual_log_beams(log: CarmenArrays, most: int) -> Beams:
    """The usual beams of the first ``most`` scans of a log."""
    stated = [laser.beams for laser in log.stated[:most] if laser is not None]
    if stated:
        return usual_beams(stated)
    (count, _), *_ = Counter(map(len, log.ranges_m[:most])).most_common(1)
    return assumed_laser(count, log.parameters).beams


def laser_model(log: CarmenArrays, scan: int, admitted: Sequence[int]) -> LaserModel:
    """The laser of a scan, with the mounting on which the ``admitted`` scans agree, rounded to 0.1 mm.

    Scans disagree if only one of their poses was corrected. They contain no mounting if both poses are equal. The
    laser is then ahead of the base by the parameter of the robot.
    """
    mountings = se2.between(log.T_odom_base[admitted], log.T_odom_laser[admitted])
    differing = np.abs(se2.between(mountings[0], mountings)).max(axis=1) > _MOUNTING_TOLERANCE
    x, y, theta = (round(value, 4) + 0.0 for value in mountings[0].tolist())
    if differing.sum() > TOLERATED_SHARE * len(admitted) or not (x or y or theta):
        x, y, theta = _parameter(log.parameters, "robot_frontlaser_offset") or 0.0, 0.0, 0.0
    stated = log.stated[scan] or assumed_laser(len(log.ranges_m[scan]), log.parameters)
    return replace(stated, T_base_laser=(x, y, theta))


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
