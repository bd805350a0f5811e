"""CARMEN logs: one message a line, metres and radians.

    PARAM name value ipc_hostname logger_timestamp
    ODOM x y theta tv rv accel ipc_timestamp ipc_hostname logger_timestamp
    FLASER n r1..rn x y theta odom_x odom_y odom_theta ipc_timestamp ipc_hostname logger_timestamp
    RAWLASER1 type start_angle fov resolution max_range accuracy remission_mode n r1..rn n_remission [..]
        ipc_timestamp ipc_hostname logger_timestamp
    ROBOTLASER1 type start_angle fov resolution max_range accuracy remission_mode n r1..rn n_remission [..]
        laser_x laser_y laser_theta robot_x robot_y robot_theta tv rv forward_safety side_safety turn_axis
        ipc_timestamp ipc_hostname logger_timestamp

A scan's stamp is the IPC timestamp. Both poses are in ``odom``: the first the laser's, the second the robot's.
RAWLASER1 is read where the beginning of a log has no other scans, as logs often have each scan twice; its pose is
that of the odometry before it. The times may be missing: then scans are 1 s apart. Other messages (rear lasers, SYNC,
TRUEPOS ...) are passed over; a line that starts with no message name is broken.
"""

import re
from collections.abc import Callable
from math import isfinite, nan
from typing import NamedTuple

import numpy as np

from fcslam.geometry.beams import is_field_of_view
from fcslam.records import Beams, LaserModel, Ranges, frozen
from fcslam.sources.pose import LARGEST_COORDINATE, Pose

SICK_MAX_RANGE_M = 50.0
"""SICK scanners send it, or more, for no return."""
_LONGEST_RANGE_M = 1e6

_RAW, _SCAN = (
    re.compile(rb"^[ \t]*(" + name + rb")\s", re.MULTILINE) for name in (rb"RAWLASER1", rb"FLASER|ROBOTLASER1")
)
SICK_TYPES = (0, 1)
"""Values of ROBOTLASER1's ``type`` that mean a SICK LMS or PLS."""

_MESSAGE = re.compile(rb"\s*(#|$|[A-Z][A-Z0-9_-]*(?=\s|$))")
_KNOWN = re.compile(
    rb"^[ \t]*(#.*CARMEN|(PARAM|SYNC|ODOM|[FR]LASER|RAWLASER\d|ROBOTLASER\d|NEFF|TRUEPOS)\s)", re.MULTILINE
)


class ScanLine(NamedTuple):
    """One scan."""

    stamp: float
    """Seconds; NaN if the log states none."""
    T_odom_base: Pose
    T_odom_laser: Pose
    ranges_m: Ranges
    """Those that are negative, not finite or too large are NaN."""
    stated: LaserModel | None = None
    """The laser that the line states, without its mounting."""
    is_timed: bool = True
    """False once a stamp stands where the log states none."""


class OdometryLine(NamedTuple):
    """One reading of the odometry."""

    stamp: float
    T_odom_base: Pose


Line = ScanLine | OdometryLine


def is_carmen(head: bytes) -> bool:
    """Whether the first bytes of a file are those of a CARMEN log."""
    return bool(_KNOWN.search(head))


def is_raw(head: bytes) -> bool:
    """Whether the log has raw scans only."""
    return bool(_RAW.search(head) and not _SCAN.search(head))


class CarmenParser:
    """Parses the lines of one pass over a log; holds the latest odometry and the settings of the robot."""

    def __init__(self, raw: bool) -> None:
        """``raw``: scans are RAWLASER1 only."""
        self.parameters: dict[str, str] = {}
        self._T_odom_base: Pose | None = None
        self._parsers: dict[bytes, Callable[[bytes], Line | None]] = {
            **(
                {b"RAWLASER1": self._rawlaser} if raw else {b"FLASER": _parse_flaser, b"ROBOTLASER1": _parse_robotlaser}
            ),
            b"ODOM": self._odometry,
            b"PARAM": self._parameter,
        }

    def __call__(self, line: bytes) -> Line | None:
        """The message of a line; None if it is not used. Raises ValueError for a broken line."""
        message = _MESSAGE.match(line)
        if message is None:
            raise ValueError("no CARMEN message")
        parser = self._parsers.get(message[1])
        return parser(line.replace(b",", b".")) if parser else None  # some languages write decimal commas

    def _rawlaser(self, line: bytes) -> ScanLine:
        front, *tail = line.rsplit(None, 3)
        measured = _measured(front)
        if self._T_odom_base is None:
            raise ValueError("no odometry before the scan")
        return ScanLine(_stamp_of(tail[0]), self._T_odom_base, self._T_odom_base, *measured)

    def _odometry(self, line: bytes) -> OdometryLine:
        words = line.split()
        if len(words) < 7:
            raise ValueError("too few words")
        self._T_odom_base = _pose_of(words[1:4])
        return OdometryLine(_stamp_of(words[7]) if len(words) >= 10 else nan, self._T_odom_base)

    def _parameter(self, line: bytes) -> None:
        _, name, value, *_ = line.decode("ascii", errors="replace").split()
        self.parameters[name] = value


def _parse_flaser(line: bytes) -> ScanLine:
    front, *tail = line.rsplit(None, 9)
    _, count, *words = front.split()
    is_timed = len(words) == int(count)
    if not is_timed:
        front, *tail = line.rsplit(None, 6)
        _, _, *words = front.split()
    stamp = _stamp_of(tail[6]) if is_timed else nan
    return ScanLine(stamp, _pose_of(tail[3:6]), _pose_of(tail[:3]), _ranges_of(words, int(count)))


def _parse_robotlaser(line: bytes) -> ScanLine:
    front, *tail = line.rsplit(None, 14)
    measured = _measured(front)
    return ScanLine(_stamp_of(tail[11]), _pose_of(tail[3:6]), _pose_of(tail[:3]), *measured)


def _measured(front: bytes) -> tuple[Ranges, LaserModel]:
    """Ranges and laser in a line up to its remissions."""
    _, kind, start, fov, resolution, max_range, _, _, count, *words = front.split()
    beam_count = int(count)
    if not 0 < beam_count < len(words) or len(words) != beam_count + 1 + int(words[beam_count]):
        raise ValueError("not as many ranges and remissions as stated")
    ranges_m = _ranges_of(words[:beam_count], beam_count)
    numbers = [float(token) for token in (start, fov, resolution, max_range)]
    return ranges_m, _stated_laser(int(kind), numbers, beam_count)


def _ranges_of(words: list[bytes], beam_count: int) -> Ranges:
    if beam_count < 2 or len(words) != beam_count:
        raise ValueError("not as many ranges as stated")
    values = np.array(words, dtype=np.float64)
    if not (values.min() >= 0.0 and values.max() < _LONGEST_RANGE_M):
        values = np.where((values >= 0.0) & np.isfinite(values), np.minimum(values, _LONGEST_RANGE_M), nan)
    return frozen(values, np.float32)


def _stated_laser(kind: int, numbers: list[float], beam_count: int) -> LaserModel:
    start_rad, fov_rad, resolution_rad, max_range_m = numbers
    increment_rad = resolution_rad if resolution_rad > 0.0 else fov_rad / (beam_count - 1)
    if not (increment_rad > 0.0 and is_field_of_view(Beams(beam_count, start_rad, increment_rad))):
        raise ValueError("no sane field of view")
    if not 0.0 < max_range_m < float("inf"):
        max_range_m = SICK_MAX_RANGE_M
    if kind in SICK_TYPES:
        max_range_m = min(max_range_m, SICK_MAX_RANGE_M)
    return LaserModel(beam_count, start_rad, increment_rad, max_range_m)


def _pose_of(tokens: list[bytes]) -> Pose:
    """Raises ValueError for an implausible pose."""
    x, y, theta = map(float, tokens)
    limit = LARGEST_COORDINATE
    if not (-limit < x < limit and -limit < y < limit and -limit < theta < limit):
        raise ValueError("no sane pose")
    return x, y, theta


def _stamp_of(token: bytes) -> float:
    """Raises ValueError if it is not finite."""
    stamp = float(token)
    if not isfinite(stamp):
        raise ValueError("no finite stamp")
    return stamp
