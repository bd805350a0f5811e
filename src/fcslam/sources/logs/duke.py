"""Logs of Duke University's DP-SLAM: metres and radians, no stamps.

    Odometry x y theta
    Laser n r1..rn

A scan takes the pose of the odometry before it. Its 181 beams are a SICK's over 180 degrees, from right to left; 8.19 m
(8191 mm, all bits set) is not a return.
"""

import re
from math import cos, nan, pi, sin

from fcslam.sources.logs.dialect import Dialect, ScanLine, StatedLaser, check_beams, pose_of, with_points
from fcslam.sources.pose import Pose

_LASER_AHEAD_M = 0.40
"""As DP-SLAM has it; scans matched while the robot turned in place say 0.37."""
_MAX_RANGE_M = 8.18
_NUMBER = rb"[ \t]+[-+]?[0-9]+([.,][0-9]*)?([eE][-+]?[0-9]+)?"
_KNOWN = re.compile(rb"^(Odometry(" + _NUMBER + rb"){3}\s*$|Laser[ \t]+[0-9]+(" + _NUMBER + rb"){2})", re.MULTILINE)


class _DukeParser:
    """Holds the latest odometry."""

    def __init__(self) -> None:
        self._T_odom_base: Pose | None = None

    def __call__(self, line: bytes) -> ScanLine | None:
        line = with_points(line)
        keyword, *words = line.strip().split(None, 2) or [b"#"]
        if keyword == b"Laser":
            return self._scan(words)
        if keyword == b"Odometry":
            self._T_odom_base = pose_of(line.split()[1:])
        elif not keyword.startswith(b"#"):
            raise ValueError("neither odometry nor laser")
        return None

    def _scan(self, words: list[bytes]) -> ScanLine:
        count, range_text = words
        beam_count = int(count)
        check_beams(range_text, beam_count)
        if self._T_odom_base is None:
            raise ValueError("no odometry before the scan")
        geometry = StatedLaser(-pi / 2.0, pi / (beam_count - 1), _MAX_RANGE_M)
        x, y, theta = self._T_odom_base
        T_odom_laser = x + _LASER_AHEAD_M * cos(theta), y + _LASER_AHEAD_M * sin(theta), theta
        return ScanLine(nan, self._T_odom_base, T_odom_laser, beam_count, range_text, geometry)


DUKE = Dialect("DP-SLAM log", _KNOWN.search, _DukeParser)
