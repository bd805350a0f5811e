"""Convert text logs of CMU, DP-SLAM, CoreSLAM and csm to ROS 2 bags (MCAP), which fcslam maps.

    python benchmarks/convert_logs.py robotdata1.log.gz robotdata2.log.gz -o bags

| logs | lines |
|---|---|
| CMU (Wean Hall) | `O x y theta stamp` and `L x y theta laser_x laser_y laser_theta r1..rn stamp`, centimetres |
| DP-SLAM (Duke) | `Odometry x y theta` and `Laser n r1..rn`, metres; no stamps, so scans are 1 s apart |
| CoreSLAM (Mines ParisTech) | 707 or 695 numbers: microseconds, encoder ticks, millimetres of a URG-04LX |
| csm (canonical scan matcher) | a JSON object with `readings`, `min_theta`, `max_theta`, `odometry`, `timestamp` |

A scan of DP-SLAM takes the odometry before it. Its laser is 0.40 m ahead of the base; 8.19 m (all bits set) is not a
return. The rover of Mines ParisTech hides the first and the last 70 beams of its laser, and a range below 20 mm is an
error code. Its scans are older than the ticks in their lines: in six recordings, headings by scan matching follow those
of the wheels after 0.14 to 0.16 s. So a scan takes the odometry of 0.15 s before. Damaged lines are left out.
"""

import argparse
import hashlib
import json
import math
import sys
import tempfile
from collections import Counter, deque
from collections.abc import Callable, Iterator, Sequence
from itertools import islice
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from fcslam.geometry import se2
from fcslam.geometry.beams import is_field_of_view
from fcslam.records import Beams, LaserModel, LaserScan, frozen
from fcslam.sources import write_bag
from fcslam.untrusted import open_unpacked

Parser = Callable[[str], LaserScan | None]
"""Parses a line; None if it holds no scan. Raises ValueError if it is damaged."""

LONGEST_RANGE_M = 50.0
"""SICK scanners send 50 m and more for no return."""
LARGEST = 1e7
"""A larger pose, in metres and radians, is damage."""
LINES_RECOGNIZED = 100
BAGS = Path(tempfile.gettempdir(), "fcslam-bags")
SUFFIXES = ".gz", ".log", ".dat", ".txt", ".json"


def pose_of(x: Any, y: Any, theta: Any, unit_m: float = 1.0) -> np.ndarray:
    pose = np.array([float(x), float(y), float(theta)]) * (unit_m, unit_m, 1.0)
    if not np.abs(pose).max() < LARGEST:
        raise ValueError("no valid pose")
    return frozen(pose)


def scan_of(
    stamp: float, words: Sequence[Any], beams: Beams | None, max_range_m: float, T_base_laser: Sequence[float],
    T_odom_base: np.ndarray, unit_m: float = 1.0,
) -> LaserScan:  # fmt: skip
    """A scan; without ``beams``, as many as there are span 180 degrees, one of them straight ahead."""
    count = len(words)
    ranges_m = np.array(words, np.float64) * unit_m
    ranges_m[ranges_m >= max_range_m] = np.inf
    if count < 2 or not math.isfinite(stamp):
        raise ValueError("no valid scan")
    if beams is None:
        increment_rad = math.radians(90.0 / (count // 2))
        beams = Beams(count, -(count // 2) * increment_rad, increment_rad)
    x, y, theta = map(float, T_base_laser)
    laser = LaserModel(*beams, max_range_m, (x, y, theta))
    return LaserScan(stamp, frozen(ranges_m, np.float32), laser, T_odom_base)


class Cmu:
    """Centimetres; the two poses of the first scan say where the laser is.

    Lines of odometry alone are left out: scans have their own, of about 0.14 s before the stamp, and both would zigzag.
    """

    def __init__(self) -> None:
        self._mounting: tuple[float, ...] | None = None

    def __call__(self, line: str) -> LaserScan | None:
        match line.replace(",", ".").split():
            case ["L", x, y, theta, laser_x, laser_y, laser_theta, *ranges, stamp]:
                base = pose_of(x, y, theta, 0.01)
                if self._mounting is None:
                    laser = pose_of(laser_x, laser_y, laser_theta, 0.01)
                    self._mounting = tuple((se2.between(base, laser).round(4) + 0.0).tolist())
                return scan_of(float(stamp), ranges, None, LONGEST_RANGE_M, self._mounting, base, 0.01)
        return None


class DpSlam:
    """Metres, without stamps."""

    def __init__(self) -> None:
        self._T_odom_base: np.ndarray | None = None
        self._scans = 0

    def __call__(self, line: str) -> LaserScan | None:
        match line.replace(",", ".").split():
            case ["Odometry", x, y, theta]:
                self._T_odom_base = pose_of(x, y, theta)
            case ["Laser", count, *ranges] if self._T_odom_base is not None and int(count) == len(ranges):
                beams = Beams(len(ranges), -math.pi / 2.0, math.pi / (len(ranges) - 1))
                self._scans += 1
                return scan_of(self._scans - 1.0, ranges, beams, 8.18, (0.40, 0.0, 0.0), self._T_odom_base)
        return None


class CoreSlam:
    """Adds up what the wheels turned from line to line, along an arc, taken as its chord."""

    BEAMS, HIDDEN, MIDDLE = 682, 70, 340
    INCREMENT_RAD = 2.0 * math.pi / 1024.0
    M_PER_TICK = 2.0 * math.pi * 0.077 / 2000.0
    TRACK_M = 2.0 * 0.165
    SCAN_AGE_S = 0.15
    LONGEST_STEP_M = 10.0
    """A wheel that went farther between two lines is damage, unless the next line agrees: the encoders were reset."""
    COLUMNS: ClassVar = {25 + BEAMS: (2, 3, 1), 13 + BEAMS: (1, 2, -1)}
    """Columns of the left and the right encoder, and the sign of the right one, by the number of words."""

    def __init__(self) -> None:
        self._ticks: np.ndarray | None = None
        self._refused: np.ndarray | None = None
        self._newest = np.zeros(3)
        self._recent: deque[tuple[float, np.ndarray]] = deque(maxlen=8)

    def __call__(self, line: str) -> LaserScan | None:
        words = line.split()
        if len(words) not in self.COLUMNS:
            return None
        left, right, sign = self.COLUMNS[len(words)]
        stamp = float(words[0]) * 1e-6
        seen = [0 if float(word) < 20 else word for word in words[-self.BEAMS :][self.HIDDEN : -self.HIDDEN]]
        beams = Beams(len(seen), (self.HIDDEN - self.MIDDLE) * self.INCREMENT_RAD, self.INCREMENT_RAD)
        self._drive(np.array([float(words[left]), sign * float(words[right])]))
        self._recent.append((stamp, self._newest))
        T_odom_base = frozen(self._pose_at(stamp - self.SCAN_AGE_S))
        return scan_of(stamp, seen, beams, 5.6, (0.145, 0.0, 0.0), T_odom_base, 0.001)

    def _drive(self, ticks: np.ndarray) -> None:
        known = [
            before for before in (ticks if self._ticks is None else self._ticks, self._refused) if before is not None
        ]
        steps_m = [(ticks - before) * self.M_PER_TICK for before in known]
        step_m = next((step_m for step_m in steps_m if np.abs(step_m).max() <= self.LONGEST_STEP_M), None)
        if step_m is None:
            self._refused = ticks
            raise ValueError("no valid count of ticks")
        self._ticks, self._refused = ticks, None
        left_m, right_m = step_m.tolist()
        x, y, theta = self._newest.tolist()
        turn_rad, ahead_m = (right_m - left_m) / self.TRACK_M, 0.5 * (left_m + right_m)
        heading_rad = theta + 0.5 * turn_rad
        self._newest = np.array(
            [x + ahead_m * math.cos(heading_rad), y + ahead_m * math.sin(heading_rad), theta + turn_rad]
        )

    def _pose_at(self, stamp: float) -> np.ndarray:
        """The odometry at a time between two lines; before the oldest one, its."""
        stamps, poses = zip(*self._recent, strict=True)
        return np.array([np.interp(stamp, stamps, values) for values in np.array(poses).T])


def csm(line: str) -> LaserScan | None:
    """A reading that is null or not valid is no return; without odometry the pose is unknown."""
    if not line.lstrip().startswith("{"):
        return None
    try:
        content = json.loads(line)
        readings = content["readings"]
        valid = content.get("valid") or [1] * len(readings)
        values = [float(each) if each is not None and ok else 0.0 for each, ok in zip(readings, valid, strict=True)]
        theta = content.get("theta") or [content["min_theta"], content["max_theta"]]
        odometry, stated = content.get("odometry") or [None], content.get("timestamp")
        seconds, microseconds = (*(stated if isinstance(stated, list) else [stated]), 0)[:2]
        stamp = float(seconds) + float(microseconds) * 1e-6
        pose = frozen(np.full(3, np.nan)) if None in odometry else pose_of(*odometry)
    except (KeyError, TypeError, IndexError, RecursionError) as error:
        raise ValueError("no scan of csm") from error
    first_rad, last_rad = float(theta[0]), float(theta[-1])
    if last_rad < first_rad:
        first_rad, last_rad, values = last_rad, first_rad, values[::-1]
    beams = Beams(len(values), first_rad, (last_rad - first_rad) / max(len(values) - 1, 1))
    if not is_field_of_view(beams):
        raise ValueError("no valid field of view")
    return scan_of(stamp, np.fmax(values, 0.0).tolist(), beams, LONGEST_RANGE_M, (0.0, 0.0, 0.0), pose)


KINDS: tuple[Callable[[], Parser], ...] = (Cmu, DpSlam, CoreSlam, lambda: csm)


def parsed(lines: Iterator[str], parser: Parser) -> Iterator[LaserScan]:
    """The records of the lines that are not damaged."""
    for line in lines:
        try:
            record = parser(line)
        except ValueError:
            continue
        if record is not None:
            yield record


def lines_of(log: Path) -> Iterator[str]:
    with open_unpacked(log) as file:
        yield from (line.decode("ascii", "replace") for line in file)


def records_of(log: Path) -> Iterator[LaserScan] | None:
    """The records of a log; None if it is of no kind that is converted here."""
    head = list(islice(lines_of(log), LINES_RECOGNIZED))
    found = Counter({kind: sum(1 for _ in parsed(iter(head), kind())) for kind in KINDS})
    (kind, count), *_ = found.most_common(1)
    return parsed(lines_of(log), kind()) if count else None


def name_of(log: Path) -> str:
    """The name of the bag: that of the log without the suffixes of logs."""
    name = log
    while name.suffix in SUFFIXES:
        name = name.with_suffix("")
    return f"{name.name}.mcap"


def readable(recording: Path, bags: Path = BAGS) -> Path:
    """The recording, or the bag of a log that is converted here, which stays in the folder ``bags``."""
    if recording.is_dir() or not {".log", ".dat", ".txt", ".json"} & set(recording.suffixes):
        return recording
    about = recording.stat()
    state = f"{recording.resolve()} {about.st_size} {about.st_mtime_ns}".encode() + Path(__file__).read_bytes()
    bag = Path(bags, hashlib.sha256(state).hexdigest()[:16], name_of(recording))
    if not bag.exists():
        records = records_of(recording)
        if records is None:
            return recording
        bag.parent.mkdir(parents=True, exist_ok=True)
        write_bag(bag, records)
    return bag


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("logs", type=Path, nargs="+", help="logs, compressed or not")
    parser.add_argument("--output", "-o", type=Path, required=True, help="folder of the bags")
    chosen = parser.parse_args()
    chosen.output.mkdir(parents=True, exist_ok=True)
    for log in chosen.logs:
        records = records_of(log)
        if records is None:
            sys.exit(f"{log}: not a log of CMU, DP-SLAM, CoreSLAM or csm")
        write_bag(chosen.output / name_of(log), records)
        print(chosen.output / name_of(log))


if __name__ == "__main__":
    main()
