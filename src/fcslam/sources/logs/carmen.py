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
from array import array
from collections.abc import Sequence
from itertools import pairwise
from math import inf, isfinite, nan
from pathlib import Path

import numpy as np

from fcslam.compiled import njit
from fcslam.geometry.beams import is_field_of_view
from fcslam.records import Beams, FloatArray, LaserModel, Ranges, frozen
from fcslam.sources.logs.archive import head, numbered_lines, translate_errors
from fcslam.sources.pose import LARGEST_COORDINATE, Pose
from fcslam.untrusted import check_unpacked

SICK_MAX_RANGE_M = 50.0
"""SICK scanners send it, or more, where they measure nothing: it is invalid."""
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

BROKEN = -(2**63)
"""Stands for a line that cannot be read."""
UNTIMED_STEP_S = 1.0
"""Time between the scans of a log that states none."""
_DIGITS = 15
"""Numbers of up to this many digits and powers of ten are exact in double precision: their ratio is rounded once."""
_POWERS = 10.0 ** np.arange(_DIGITS + 1)


def is_carmen(head: bytes) -> bool:
    """Whether the first bytes of a file are those of a CARMEN log."""
    return bool(_KNOWN.search(head))


class CarmenArrays:
    """The content of a log. Scans and readings of the odometry are counted from 0, each for themselves."""

    def __init__(self, path: Path) -> None:
        """Read the log."""
        self.numbers, self.contents = array("q"), array("q")
        """Numbers, from 1, of the lines that are used, and what each holds: k is scan k, ``~k`` is reading k."""
        self.stamps, self.odometry_stamps = array("d"), array("d")
        """Stamps of the scans and of the odometry readings, seconds."""
        self.untimed = set[int]()
        """Scans whose stamps the log does not state."""
        self.invalid: dict[int, int] = {}
        """Scans with invalid ranges, and how many."""
        self.stated: list[LaserModel | None] = []
        """The laser that the line of each scan states, without its mounting."""
        self.parameters: dict[str, str] = {}
        """Settings of the robot."""
        self._poses, self._odometry, self._ranges_m, self._ends = array("d"), array("d"), array("f"), [0]
        beginning = head(path)
        is_raw = bool(_RAW.search(beginning) and not _SCAN.search(beginning))  # scans are RAWLASER1 only
        scans = (
            {b"RAWLASER1": self._rawlaser} if is_raw else {b"FLASER": self._flaser, b"ROBOTLASER1": self._robotlaser}
        )
        parsers = {**scans, b"ODOM": self._odom, b"PARAM": self._parameter}
        with translate_errors(path):
            size = path.stat().st_size
            for number, line in numbered_lines(path):
                try:
                    message = _MESSAGE.match(line)
                    if message is None:
                        raise ValueError("not a CARMEN message")
                    parse = parsers.get(message[1])
                    content = parse(line.replace(b",", b".")) if parse else None  # some languages write decimal commas
                except ValueError:
                    content = BROKEN
                if content is not None:
                    self.numbers.append(number)
                    self.contents.append(content)
                check_unpacked(size, 4 * len(self._ranges_m) + 16 * len(self.numbers))
        if 1 < len(self.stamps) > 100 * (len(set(self.stamps)) - 1):  # such as 1.01893e+09, with six digits
            self._number_scans()
        poses: FloatArray = frozen(np.frombuffer(self._poses).reshape(-1, 6))
        self.T_odom_laser, self.T_odom_base = poses[:, :3], poses[:, 3:]
        """Poses of laser and base at the scans, shape (S, 3)."""
        self.odometry: FloatArray = frozen(np.frombuffer(self._odometry).reshape(-1, 3))
        """T_odom_base of the readings, shape (R, 3)."""
        ranges_m: Ranges = frozen(np.frombuffer(self._ranges_m, np.float32), np.float32)
        self.ranges_m = [ranges_m[begin:end] for begin, end in pairwise(self._ends)]
        """Ranges of each scan; NaN where negative, not finite or too large."""

    def beams_of(self, scan: int, declared: Beams) -> Beams | None:
        """The beams that a scan states, or those of the laser; None if there are more or fewer and no angles."""
        stated = self.stated[scan]
        if stated is not None:
            return stated.beams
        return declared if len(self.ranges_m[scan]) == declared.beam_count else None

    def _number_scans(self) -> None:
        self.stamps, self.untimed = array("d"), set(range(len(self.stamps)))
        for content in self.contents:
            if content >= 0:
                self.stamps.append(len(self.stamps) * UNTIMED_STEP_S)
            elif content != BROKEN:
                self.odometry_stamps[~content] = len(self.stamps) * UNTIMED_STEP_S

    def _flaser(self, line: bytes) -> int:
        front, *tail = line.rsplit(None, 9)
        _, count, *text = front.split(None, 2)
        values, rest = numbers_in(b"".join(text), int(count))
        if len(values) and not rest.strip():
            return self._scan(_stamp_of(tail[6]), tail[:6], values)
        front, *tail = line.rsplit(None, 6)
        _, _, *text = front.split(None, 2)
        values, rest = numbers_in(b"".join(text), int(count))
        if rest.strip():
            raise ValueError("number of ranges differs from the stated one")
        return self._scan(None, tail, values)

    def _robotlaser(self, line: bytes) -> int:
        front, *tail = line.rsplit(None, 14)
        measured = _measured(front)  # refuses what is too short
        return self._scan(_stamp_of(tail[11]), tail[:6], *measured)

    def _rawlaser(self, line: bytes) -> int:
        front, *tail = line.rsplit(None, 3)
        measured = _measured(front)
        if not self._odometry:
            raise ValueError("no odometry before the scan")
        return self._scan(_stamp_of(tail[0]), 2 * self._odometry[-3:].tolist(), *measured)

    def _scan(
        self,
        stamp: float | None,
        poses: Sequence[bytes | float],
        ranges_m: FloatArray,
        stated: LaserModel | None = None,
    ) -> int:
        """Add a scan; the log states no ``stamp`` if it is None."""
        if len(ranges_m) == 0:
            raise ValueError("number of ranges differs from the stated one")
        self._poses.extend(_pose_of(poses[:3]) + _pose_of(poses[3:]))
        scan = len(self.stamps)
        if not (ranges_m.min() >= 0.0 and ranges_m.max() < _LONGEST_RANGE_M):
            is_range = (ranges_m >= 0.0) & np.isfinite(ranges_m)
            self.invalid[scan] = int(np.count_nonzero(~is_range))
            ranges_m = np.where(is_range, np.minimum(ranges_m, _LONGEST_RANGE_M), nan)
        self._ranges_m.frombytes(ranges_m.astype(np.float32).tobytes())
        self._ends.append(len(self._ranges_m))
        self.stated.append(stated)
        self.stamps.append(len(self.untimed) * UNTIMED_STEP_S if stamp is None else stamp)
        if stamp is None:
            self.untimed.add(scan)
        return scan

    def _odom(self, line: bytes) -> int:
        words = line.split()
        if len(words) < 7:
            raise ValueError("too few words")
        pose, is_timed = _pose_of(words[1:4]), len(words) >= 10
        self.odometry_stamps.append(_stamp_of(words[7]) if is_timed else len(self.untimed) * UNTIMED_STEP_S)
        self._odometry.extend(pose)
        return -len(self.odometry_stamps)

    def _parameter(self, line: bytes) -> None:
        _, name, value, *_ = line.decode("ascii", errors="replace").split()
        self.parameters[name] = value


def _measured(front: bytes) -> tuple[FloatArray, LaserModel]:
    """Ranges and laser in a line up to its remissions."""
    _, kind, start, fov, resolution, max_range, _, _, count, text = front.split(None, 9)
    values, rest = numbers_in(text, int(count))
    remission_count, *remissions = rest.split()
    if len(remissions) != int(remission_count):
        raise ValueError("number of remissions differs from the stated one")
    start_rad, fov_rad, increment_rad, max_range_m = map(float, (start, fov, resolution, max_range))
    if not increment_rad > 0.0:
        increment_rad = fov_rad / (len(values) - 1)
    if not (increment_rad > 0.0 and is_field_of_view(Beams(len(values), start_rad, increment_rad))):
        raise ValueError("invalid field of view")
    if not 0.0 < max_range_m < inf:
        max_range_m = SICK_MAX_RANGE_M
    if int(kind) in SICK_TYPES:
        max_range_m = min(max_range_m, SICK_MAX_RANGE_M)
    return values, LaserModel(len(values), start_rad, increment_rad, max_range_m)


def numbers_in(text: bytes, count: int) -> tuple[FloatArray, bytes]:
    """The first ``count`` numbers of a text, and what follows them; none if it has fewer."""
    if not 2 <= count <= len(text):
        return np.zeros(0), text
    values = np.empty(count)
    end = _plain_numbers(np.frombuffer(text, np.uint8), values)
    if end >= 0:
        return values, text[end:]
    words = text.split(None, count)
    if len(words) < count:
        return np.zeros(0), text
    return np.array(words[:count], np.float64), b"".join(words[count:])


@njit(allocates=False)
def _plain_numbers(text, values):  # type: ignore[no-untyped-def]
    """Read numbers of digits and a point, separated by white space; returns where they end, -1 if one is not plain."""
    at = 0
    for k in range(len(values)):
        while at < len(text) and (text[at] == 32 or 9 <= text[at] <= 13):
            at += 1
        number, digits, decimals, is_decimal = 0, 0, 0, False
        while at < len(text) and not (text[at] == 32 or 9 <= text[at] <= 13):
            if text[at] == 46 and not is_decimal:
                is_decimal = True
            elif 48 <= text[at] <= 57:
                number = 10 * number + (text[at] - 48)
                digits += 1
                decimals += is_decimal
            else:
                return -1
            at += 1
        if not 0 < digits <= _DIGITS:
            return -1
        values[k] = number / _POWERS[decimals]
    return at


def _pose_of(tokens: Sequence[bytes | float]) -> Pose:
    """Raises ValueError for an implausible pose."""
    x, y, theta = map(float, tokens)
    limit = LARGEST_COORDINATE
    if not (-limit < x < limit and -limit < y < limit and -limit < theta < limit):
        raise ValueError("invalid pose")
    return x, y, theta


def _stamp_of(token: bytes) -> float:
    """Raises ValueError if it is not finite."""
    stamp = float(token)
    if not isfinite(stamp):
        raise ValueError("invalid stamp")
    return stamp
