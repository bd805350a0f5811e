"""The laser geometry of a log, which old logs do not state.

A geometry stated in a scan line (ROBOTLASER1) is used. Otherwise the beam count decides:

- parameters ``laser_front_laser_resolution`` and ``laser_front_laser_fov`` where both are there and fit the count, or
  ``laser_front_laser_fov`` alone;
- 101, 201 and 401 beams are a SICK that looks over 100 degrees, 541 and 1081 a scanner that looks over 270 degrees;
- any other count spans 180 degrees: 180 beams are 1 degree apart (-90 .. +89), 181 too (-90 .. +90), 360 and 361
  are 0.5 degrees apart.

In all of them beam ``n // 2`` looks straight ahead. If the count alternates between two neighbours, as 181, 180, 180,
180, the scanner interleaves its scans: those with one beam less lie between the beams of the others.

A range of 50 m or more is not a return. SICK scanners send 81.8 to 81.9 m, about 51.2 m or 50 m for it, depending on
their resolution, and logs do not say which; beyond 50 m indoors nothing is lost. The parameter
``robot_front_laser_max`` does not help: it belongs to obstacle avoidance, and a log with 10 m has good returns at 12 m.
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from itertools import pairwise
from math import degrees, isfinite, radians
from typing import NamedTuple

from fcslam.records import Beams, LaserModel
from fcslam.sources.gate import TOLERATED_SHARE, usual_beams
from fcslam.sources.logs.carmen import SICK_MAX_RANGE_M, ScanLine, StatedLaser
from fcslam.sources.pose import Pose, relative_pose

FEWEST_INTERLEAVED = 2
"""Least number of scans with each of two counts, among the first ones, of a scanner that interleaves."""

_MOUNTING_TOLERANCE = 0.01
"""Largest difference between the mountings of two scans, in metres or radians."""
_FULL_TURN_DEG = 360.0
_RESOLUTION_DEG = {101: 1.0, 201: 0.5, 401: 0.25, 541: 0.5, 1081: 0.25}


class Interleaving(NamedTuple):
    """A scanner with interleaved scans, for example a SICK: the first of a cycle has one more beam."""

    full_count: int
    """Beams of the first scan of a cycle; the others have one less."""
    cycle: int | None
    """Scans in a cycle; None if scans are missing, so that the place of a scan in its cycle is not known."""


def first_beams(scans: Sequence[ScanLine], parameters: Mapping[str, str]) -> tuple[Beams, Interleaving | None]:
    """The usual beams of the first scans of a log, and whether those that state no angles interleave."""
    stated = [Beams(scan.beam_count, *scan.stated[:2]) for scan in scans if scan.stated is not None]
    if stated:
        return usual_beams(stated), None
    counts = [scan.beam_count for scan in scans]
    interleaved = interleaving(counts)
    (usual, _), *_ = Counter(counts).most_common(1)
    full = usual if interleaved is None else interleaved.full_count
    return Beams(full, *assumed_laser(full, parameters)[:2]), interleaved


def interleaving(beam_counts: Sequence[int]) -> Interleaving | None:
    """Whether consecutive scans with these counts, which state no angles, interleave."""
    (usual, _), *_ = Counter(beam_counts).most_common(1)
    for full in (usual, usual + 1):
        if min(beam_counts.count(full), beam_counts.count(full - 1)) >= FEWEST_INTERLEAVED:
            starts = [k for k, count in enumerate(beam_counts) if count == full]
            steps = {after - before for before, after in pairwise(starts)}
            return Interleaving(full, steps.pop() if len(steps) == 1 else None)
    return None


class LogBeams:
    """The beams of the scans of one pass over a log, line by line."""

    def __init__(self, declared: Beams, interleaving: Interleaving | None) -> None:
        """``declared`` are those of the laser; with interleaving, of the first scan of a cycle."""
        self._declared = declared
        self._interleaving = interleaving
        self._since_full = 0

    def of(self, scan: ScanLine) -> Beams | None:
        """The beams that the line states, or those of the laser; None if there are more or fewer and no angles.

        A scan between two full ones is turned by its share of an increment, by half if its place is not known.
        """
        if scan.stated is not None:
            return Beams(scan.beam_count, scan.stated.angle_min_rad, scan.stated.angle_increment_rad)
        self._since_full = 0 if scan.beam_count == self._declared.beam_count else self._since_full + 1
        if not self._since_full:
            return self._declared
        if self._interleaving is None or scan.beam_count != self._declared.beam_count - 1:
            return None
        cycle = self._interleaving.cycle
        share = self._since_full / cycle if cycle is not None and self._since_full < cycle else 0.5
        _, first_rad, increment_rad = self._declared
        return Beams(scan.beam_count, first_rad + share * increment_rad, increment_rad)


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


def tells_more(scan: ScanLine, than: ScanLine) -> bool:
    """Whether a scan says more about the laser: the angles of its beams, or how many beams a full scan has."""
    if than.stated is not None:
        return False
    if scan.stated is not None:
        return scan.beam_count == than.beam_count
    return scan.beam_count > than.beam_count


def laser_model(scan: ScanLine, parameters: Mapping[str, str], mounting: MountingEstimate) -> LaserModel:
    """The laser of ``scan``."""
    T_base_laser = mounting.T_base_laser(_parameter(parameters, "robot_frontlaser_offset") or 0.0)
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
    """A parameter's value; None if it is missing or not a finite number."""
    try:
        value = float(parameters[name])
    except (KeyError, ValueError):
        return None
    return value if isfinite(value) else None
