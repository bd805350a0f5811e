"""Summary of a text log from one pass, and whether the log can be mapped."""

from pathlib import Path
from typing import NamedTuple

from fcslam.records import LaserModel
from fcslam.sources.faults import Faults
from fcslam.sources.gate import TOLERATED_SHARE, check_consistency
from fcslam.sources.logs.dialect import Line, OdometryLine, ParameterLine, ScanLine
from fcslam.sources.logs.laser import Interleaving, laser_model, parameter
from fcslam.sources.path_summary import WITHOUT_ODOMETRY, PathSummary
from fcslam.sources.pose import Pose, relative_pose
from fcslam.sources.source import Survey

_MOUNTING_TOLERANCE = 0.01
"""Largest difference between the mountings of two scans, in metres or radians."""
FULL_TURN_RAD = 6.0
"""A scanner whose beams span more measures a full turn."""
SPINNING_HZ = 4.0, 20.0
"""Turns a second of scanners that spin, and log every turn."""


class LogReading(NamedTuple):
    """Summary of a log, and how to read it."""

    survey: Survey
    interleaving: Interleaving | None
    pose_from_odometry: bool
    """Whether scans take the pose of the latest odometry message, because their own never changes."""
    has_odometry: bool
    """Whether the poses are those of wheels."""
    placeholders: tuple[float, ...] = ()
    """Values that are not ranges."""


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


class Overview:
    """Collects the summary of a log line by line."""

    def __init__(self) -> None:
        self._scans = PathSummary()
        self._odometry = PathSummary()
        self._mounting = MountingEstimate()
        self._parameters: dict[str, str] = {}
        self._scan: ScanLine | None = None

    def add(self, line: Line) -> None:
        """Add the next line."""
        if isinstance(line, ScanLine):
            self._scans.add(line.stamp, line.T_odom_base)
            self._mounting.add(line)
            if self._scan is None or _tells_more(line, self._scan):
                self._scan = line
        elif isinstance(line, OdometryLine):
            self._odometry.add(line.stamp, line.T_odom_base)
        elif isinstance(line, ParameterLine):
            self._parameters[line.name] = line.value

    def conclude(self, path: Path, faults: Faults, interleaving: Interleaving | None) -> LogReading:
        """Summarise the log at ``path`` after its last line.

        Raises:
            SourceError: the log is mostly damaged, or of several lasers.
        """
        assert self._scan is not None
        check_consistency(path, faults, self._scans.count, self._odometry.count)
        pose_from_odometry = not self._scans.moves and self._odometry.moves
        fault = (self._odometry if pose_from_odometry else self._scans).fault
        notes: tuple[str, ...] = (
            () if fault is None else (f"{path}: the odometry {fault}; it is not used", f"{path}: {WITHOUT_ODOMETRY}")
        )
        offset_m = parameter(self._parameters, "robot_frontlaser_offset") or 0.0
        laser = laser_model(self._scan, self._parameters, self._mounting.T_base_laser(offset_m))
        length_m = self._odometry.length_m if pose_from_odometry else self._scans.length_m
        notes += _spinning(path, laser, self._scans)
        survey = Survey(self._scans.count, self._scans.duration_s, length_m, (laser,), faults, notes)
        return LogReading(survey, interleaving, pose_from_odometry, fault is None)


def _spinning(path: Path, laser: LaserModel, scans: PathSummary) -> tuple[str, ...]:
    """A note about a scanner that probably spins, as a log does not say when each beam was measured."""
    rate_hz = (scans.count - 1) / scans.duration_s if scans.duration_s > 0.0 else 0.0
    if laser.beams.span_rad < FULL_TURN_RAD or not SPINNING_HZ[0] <= rate_hz <= SPINNING_HZ[1]:
        return ()
    return (
        f"{path}: {rate_hz:.1f} scans a second of a full turn, and no times of beams; if the scanner spins, set "
        f"robot.lidar.scan_duration_s: {1.0 / rate_hz:.3f}",
    )


def _tells_more(scan: ScanLine, than: ScanLine) -> bool:
    """Whether a scan says more about the laser: the angles of its beams, or how many beams a full scan has."""
    if than.stated is not None:
        return False
    if scan.stated is not None:
        return scan.beam_count == than.beam_count
    return scan.beam_count > than.beam_count
