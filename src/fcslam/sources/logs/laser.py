"""The laser geometry of a log, which old logs do not state.

A geometry stated in a scan line (ROBOTLASER1) is used. Otherwise the beam count decides:

- parameters ``laser_front_laser_resolution`` and ``laser_front_laser_fov`` where both are there and fit the count;
- 101, 201 and 401 beams are a SICK that looks over 100 degrees, 541 and 1081 a scanner that looks over 270 degrees;
- any other count spans 180 degrees: 180 beams are 1 degree apart (-90 .. +89), 181 too (-90 .. +90), 360 and 361
  are 0.5 degrees apart.

In all of them beam ``n // 2`` looks straight ahead.

A range of 50 m or more is no return. SICK scanners send 81.8 to 81.9 m, about 51.2 m or 50 m for it, depending on
their resolution, and logs do not say which; beyond 50 m indoors nothing is lost. The parameter
``robot_front_laser_max`` does not help: it belongs to obstacle avoidance, and a log with 10 m has good returns at 12 m.
"""

from collections.abc import Mapping
from math import degrees, isfinite, radians

from fcslam.records import LaserModel
from fcslam.sources.logs.dialect import ScanLine, StatedLaser
from fcslam.sources.pose import Pose

SICK_MAX_RANGE_M = 50.0

_RESOLUTION_DEG = {101: 1.0, 201: 0.5, 401: 0.25, 541: 0.5, 1081: 0.25}


def laser_model(scan: ScanLine, parameters: Mapping[str, str], T_base_laser: Pose) -> LaserModel:
    """The laser of ``scan``."""
    stated = scan.stated or assumed_laser(scan.beam_count, parameters)
    return LaserModel(scan.beam_count, *stated, T_base_laser)


def assumed_laser(beam_count: int, parameters: Mapping[str, str] | None = None) -> StatedLaser:
    """The default geometry of a laser with ``beam_count`` (two or more) beams."""
    middle = beam_count // 2
    resolution_deg = _parameter_resolution_deg(beam_count, parameters or {})
    if resolution_deg is None:
        resolution_deg = _RESOLUTION_DEG.get(beam_count, 90.0 / middle)
    increment_rad = radians(resolution_deg)
    return StatedLaser(-middle * increment_rad, increment_rad, SICK_MAX_RANGE_M)


def _parameter_resolution_deg(beam_count: int, parameters: Mapping[str, str]) -> float | None:
    resolution_deg = parameter(parameters, "laser_front_laser_resolution")
    fov = parameter(parameters, "laser_front_laser_fov")
    if resolution_deg is None or fov is None or resolution_deg <= 0.0:
        return None
    fov_deg = degrees(fov) if fov < 7.0 else fov
    fits = abs((beam_count - 1) * resolution_deg - fov_deg) < 1.5 * resolution_deg
    return resolution_deg if fits else None


def parameter(parameters: Mapping[str, str], name: str) -> float | None:
    """A parameter's value; None if it is missing or not a finite number."""
    try:
        value = float(parameters[name])
    except (KeyError, ValueError):
        return None
    return value if isfinite(value) else None
