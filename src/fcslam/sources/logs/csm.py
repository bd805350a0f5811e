"""Logs of csm, the canonical scan matcher: one JSON object a line, metres and radians.

    {"nrays": n, "min_theta": a, "max_theta": b, "readings": [r1..rn], "valid": [..], "theta": [..],
     "odometry": [x, y, theta], "timestamp": [seconds, microseconds], ...}

A reading that is null, or not valid, is not a return. The angles are the first and the last of ``theta`` where it is
given. A scan without odometry has the pose 0, so a log of such scans is refused as one without odometry. Without
timestamps, scans are 1 s apart.
"""

import json
import re
from math import nan
from typing import Any

from fcslam.geometry.beams import is_field_of_view
from fcslam.records import Beams
from fcslam.sources.logs.dialect import Dialect, ScanLine, StatedLaser, check_beams, stamp_of
from fcslam.sources.logs.laser import SICK_MAX_RANGE_M
from fcslam.sources.pose import Pose

_KNOWN = re.compile(rb'^\s*\{.*"(nrays|readings)"\s*:', re.MULTILINE)
_MAX_COORDINATE = 1e7


def _parse(line: bytes) -> ScanLine | None:
    if not line.strip():
        return None
    try:
        return _scan(json.loads(line))
    except (KeyError, TypeError, IndexError, RecursionError) as error:
        raise ValueError("no scan of csm") from error


def _scan(content: Any) -> ScanLine:
    readings = content["readings"]
    count = len(readings)
    valid = content.get("valid") or [1] * count
    if len(valid) != count or content.get("nrays", count) != count:
        raise ValueError("not as many readings as stated")
    values = [float(value) if value is not None and ok else 0.0 for value, ok in zip(readings, valid, strict=True)]
    theta = content.get("theta") or [content["min_theta"], content["max_theta"]]
    first_rad, last_rad = float(theta[0]), float(theta[-1])
    if last_rad < first_rad:
        first_rad, last_rad, values = last_rad, first_rad, values[::-1]
    increment_rad = (last_rad - first_rad) / (count - 1) if count > 1 else 0.0
    if not is_field_of_view(Beams(count, first_rad, increment_rad)):
        raise ValueError("no sane field of view")
    text = b" ".join(b"%r" % (value if value > 0.0 else 0.0) for value in values)  # NaN is not a return
    check_beams(text, count)
    pose, stamp = _pose(content.get("odometry")), _stamp(content.get("timestamp"))
    return ScanLine(stamp, pose, pose, count, text, StatedLaser(first_rad, increment_rad, SICK_MAX_RANGE_M))


def _stamp(stated: Any) -> float:
    if not stated or not any(parts := stated if isinstance(stated, list) else [stated]):
        return nan
    seconds, microseconds = (*parts, 0)[:2]
    return stamp_of(str(seconds).encode()) + stamp_of(str(microseconds).encode()) * 1e-6


def _pose(stated: Any) -> Pose:
    if stated is None or None in stated:
        return 0.0, 0.0, 0.0
    x, y, theta = map(float, stated)
    if not max(map(abs, (x, y, theta))) < _MAX_COORDINATE:
        raise ValueError("no sane pose")
    return x, y, theta


CSM = Dialect("csm log", _KNOWN.search, lambda: _parse)
