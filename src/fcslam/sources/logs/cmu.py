"""Logs of Carnegie Mellon's Wean Hall: centimetres and radians.

    O x y theta stamp
    L x y theta laser_x laser_y laser_theta r1..rn stamp

Both poses are in ``odom``; the laser sits 25 cm ahead of the robot's centre, as the two poses say.
"""

import re

from fcslam.sources.logs.dialect import (
    Dialect,
    Line,
    OdometryLine,
    ScanLine,
    check_beams,
    pose_of,
    stamp_of,
    with_points,
)

_METRES = 0.01
_NUMBER = rb"[ \t]+[-+]?[0-9]+([.,][0-9]*)?([eE][-+]?[0-9]+)?"
_KNOWN = re.compile(rb"^(O(" + _NUMBER + rb"){4}|L(" + _NUMBER + rb"){9})", re.MULTILINE)


def _parse(line: bytes) -> Line | None:
    line = with_points(line)
    keyword = line[:2]
    if keyword == b"L ":
        return _parse_laser(line)
    if keyword == b"O ":
        _, x, y, theta, stamp = line.split()
        return OdometryLine(stamp_of(stamp), pose_of([x, y, theta], _METRES))
    if keyword[:1] == b"#" or not line.strip():
        return None
    raise ValueError("neither odometry nor laser")


def _parse_laser(line: bytes) -> ScanLine:
    _, *poses, rest = line.split(None, 7)
    range_text, stamp = rest.rsplit(None, 1)
    beam_count = len(range_text.split())
    check_beams(range_text, beam_count)
    return ScanLine(stamp_of(stamp), pose_of(poses[:3], _METRES), pose_of(poses[3:], _METRES), beam_count, range_text)


CMU = Dialect("CMU log", _KNOWN.search, lambda: _parse, _METRES)
