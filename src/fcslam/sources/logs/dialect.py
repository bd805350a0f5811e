"""The lines of a text log, common to all dialects."""

from collections.abc import Callable
from dataclasses import dataclass
from math import isfinite
from typing import NamedTuple

from fcslam.records import Ranges
from fcslam.sources.pose import Pose

_MAX_COORDINATE = 1e7
"""Metres or radians; a larger pose is damage."""
_NUMBER_LETTERS = b"0123456789.+-eEinfatyINFATY \t"


class StatedLaser(NamedTuple):
    """Laser geometry that a scan line states; radians and metres."""

    angle_min_rad: float
    angle_increment_rad: float
    max_range_m: float


class ScanLine(NamedTuple):
    """One scan, its ranges as text."""

    stamp: float
    """Seconds; NaN if the log states none."""
    T_odom_base: Pose
    T_odom_laser: Pose
    beam_count: int
    range_text: bytes
    stated: StatedLaser | None = None
    ranges_m: Ranges | None = None
    """The ranges, if they are parsed already, shape (beam_count,)."""
    is_timed: bool = True
    """False once a stamp stands where the log states none."""


class OdometryLine(NamedTuple):
    """One reading of the odometry."""

    stamp: float
    """As in ``ScanLine``."""
    T_odom_base: Pose


class ParameterLine(NamedTuple):
    """A setting of the robot that made the log."""

    name: str
    value: str


Line = ScanLine | OdometryLine | ParameterLine


LineParser = Callable[[bytes], Line | None]
"""Parses a line; None if it is not used. Raises ValueError for a broken line. Ranges stay text."""


@dataclass(frozen=True, slots=True)
class Dialect:
    """A kind of text log and its parser."""

    name: str
    recognises: Callable[[bytes], object]
    """True of the first bytes of a log of this kind."""
    parser: Callable[[], LineParser]
    """Makes a parser for one pass over a log; a line may depend on the lines before it."""
    metres_per_range_unit: float = 1.0


def pose_of(tokens: list[bytes], metres_per_unit: float = 1.0) -> Pose:
    """Parse (x, y, theta); raises ValueError for an implausible pose."""
    x, y, theta = map(float, tokens)
    limit = _MAX_COORDINATE
    if not (-limit < x < limit and -limit < y < limit and -limit < theta < limit):
        raise ValueError("no sane pose")
    return x * metres_per_unit, y * metres_per_unit, theta


def stamp_of(token: bytes) -> float:
    """Parse a stamp in seconds; raises ValueError if it is not finite."""
    stamp = float(token)
    if not isfinite(stamp):
        raise ValueError("no finite stamp")
    return stamp


def with_points(line: bytes) -> bytes:
    """A line whose numbers may have decimal commas, as some languages write them, with points."""
    return line.replace(b",", b".") if b"," in line else line


def check_beams(range_text: bytes, beam_count: int) -> None:
    """Raise ValueError unless ``range_text`` has ``beam_count`` numbers, at least two, by count and characters."""
    if beam_count < 2 or not has_beams(range_text, beam_count):
        raise ValueError("not as many ranges as stated")
    if range_text.translate(None, _NUMBER_LETTERS):
        raise ValueError("a range is not a number")


def has_beams(range_text: bytes, beam_count: int) -> bool:
    """Whether a text has ``beam_count`` words, which most often are separated by single spaces."""
    return range_text.count(b" ") + 1 == beam_count or len(range_text.split()) == beam_count
