"""Logs of the Mines ParisTech rover (CoreSLAM): millimetres, microseconds and raw encoder ticks.

    time battery left right (21 more) r1..r682
    time left right x y heading (7 more) r1..r682

The number of words says which of the two it is. In the second, the right encoder counts down as the robot drives
ahead. Odometry is integrated from the ticks, from the identity; a pose in the line is passed over.

The laser is a Hokuyo URG-04LX, 1024 steps a turn, from right to left, beam 340 straight ahead. A range below 20 mm is
an error code, and the robot's body hides the first and the last 70 beams.

A scan is older than the ticks in its line: in six recordings, headings by scan matching follow those of the wheels
after 0.14 to 0.16 s. So a scan's pose is the odometry of 0.15 s before; its stamp stays that of the line.
"""

from collections import deque
from math import cos, pi, sin
from typing import NamedTuple

from fcslam.sources.logs.dialect import Dialect, ScanLine, StatedLaser, check_beams
from fcslam.sources.pose import Pose

_METRES = 0.001
_SECONDS = 1e-6
_METRES_PER_TICK = 2.0 * pi * 0.077 / 2000.0
_TRACK_M = 2.0 * 0.165
_LASER_AHEAD_M = 0.145
_SCAN_AGE_S = 0.15

_BEAM_COUNT, _HIDDEN_BEAMS, _MIDDLE_BEAM = 682, 70, 340
_SMALLEST_RANGE = 20
_MAX_RANGE_M = 5.6
_INCREMENT_RAD = 2.0 * pi / 1024.0
_LASER = StatedLaser((_HIDDEN_BEAMS - _MIDDLE_BEAM) * _INCREMENT_RAD, _INCREMENT_RAD, _MAX_RANGE_M)

_MAX_COUNT = 1e15
"""Largest count of ticks or microseconds; a larger one is damage."""
_POSES_KEPT = 8
"""Enough to look back over ``_SCAN_AGE_S`` at 10 to 50 lines a second."""
_MAX_STEP_M = 10.0
"""A wheel that went farther between two lines is damage."""
_NUMBER_LETTERS = b"0123456789.+-eE"


class _EncoderColumns(NamedTuple):
    """Where a line has its encoders, and the sign of the right one."""

    left: int
    right: int
    right_sign: int


_LAYOUTS = {25 + _BEAM_COUNT: _EncoderColumns(2, 3, 1), 13 + _BEAM_COUNT: _EncoderColumns(1, 2, -1)}
"""By the number of words."""


class _MinesParser:
    """Adds up what the wheels turned from line to line."""

    def __init__(self) -> None:
        self._ticks: tuple[float, float] | None = None
        self._refused: tuple[float, float] | None = None
        """Counts of the line before, if they were no sane ones."""
        self._newest: Pose = (0.0, 0.0, 0.0)
        self._recent: deque[tuple[float, Pose]] = deque(maxlen=_POSES_KEPT)

    def __call__(self, line: bytes) -> ScanLine | None:
        words = line.split()
        if not words or words[0].startswith(b"#"):
            return None
        layout = _LAYOUTS.get(len(words))
        if layout is None:
            raise ValueError("no known number of words")
        stamp = _count(words[0]) * _SECONDS
        range_text = _ranges(words[-_BEAM_COUNT:])
        self._drive(_count(words[layout.left]), _count(words[layout.right]) * layout.right_sign)
        self._recent.append((stamp, self._newest))
        T_odom_base = self._pose_at(stamp - _SCAN_AGE_S)
        x, y, theta = T_odom_base
        T_odom_laser = x + _LASER_AHEAD_M * cos(theta), y + _LASER_AHEAD_M * sin(theta), theta
        return ScanLine(stamp, T_odom_base, T_odom_laser, _BEAM_COUNT - 2 * _HIDDEN_BEAMS, range_text, _LASER)

    def _drive(self, left: float, right: float) -> None:
        """Go on to these counts along an arc, taken as its chord.

        A count that no wheel can reach is damage, unless the next one is near it: then the encoders were reset.
        """
        counts = left, right
        known = (before for before in (self._ticks or counts, self._refused) if before is not None)
        before = next((before for before in known if _step_m(before, counts) <= _MAX_STEP_M), None)
        if before is None:
            self._refused = counts
            raise ValueError("no sane count of ticks")
        self._ticks, self._refused = counts, None
        left_m, right_m = (left - before[0]) * _METRES_PER_TICK, (right - before[1]) * _METRES_PER_TICK
        x, y, theta = self._newest
        turn = (right_m - left_m) / _TRACK_M
        ahead_m, heading = 0.5 * (left_m + right_m), theta + 0.5 * turn
        self._newest = x + ahead_m * cos(heading), y + ahead_m * sin(heading), theta + turn

    def _pose_at(self, stamp: float) -> Pose:
        """The odometry at this time, between two lines; before the oldest line that is kept, its."""
        after = self._recent[-1]
        for before in reversed(self._recent):
            if before[0] <= stamp:
                share = (stamp - before[0]) / (after[0] - before[0])
                x, y, theta = (a + share * (b - a) for a, b in zip(before[1], after[1], strict=True))
                return x, y, theta
            after = before
        return after[1]


def _step_m(before: tuple[float, float], after: tuple[float, float]) -> float:
    """The longer way of both wheels between these counts."""
    return max(abs(after[0] - before[0]), abs(after[1] - before[1])) * _METRES_PER_TICK


def _count(word: bytes) -> float:
    count = float(word)
    if not abs(count) < _MAX_COUNT:
        raise ValueError("no sane count")
    return count


def _ranges(words: list[bytes]) -> bytes:
    """The ranges of the beams that see past the robot, error codes as 0."""
    seen = words[_HIDDEN_BEAMS:-_HIDDEN_BEAMS]
    text = b" ".join(b"0" if len(word) < 3 and int(word) < _SMALLEST_RANGE else word for word in seen)
    check_beams(text, len(seen))
    return text


def _recognises(head: bytes) -> bool:
    return any(
        len(line.split()) in _LAYOUTS and not line.translate(None, _NUMBER_LETTERS).strip()
        for line in head.splitlines()
    )


MINES = Dialect("CoreSLAM log", _recognises, _MinesParser, _METRES)
