"""Reads a text log: surveys it once, then streams its records.

Besides the rules of ``gate``:

- Scans of a dialect without stamps get stamps 1 s apart, and are counted.
- A log of ten or more scans in which neither the poses of scans nor the odometry messages ever change has no odometry
  and is rejected. If only the odometry messages change, a scan takes the pose of the message before it.
"""

from collections import Counter
from collections.abc import Iterator
from functools import cached_property
from itertools import islice
from math import nan
from pathlib import Path

import numpy as np

from fcslam.errors import SourceError
from fcslam.records import LaserScan, Odometry, Ranges, SensorRecord
from fcslam.sources.faults import Audit, Fault, Faults
from fcslam.sources.gate import SCANS_THAT_VOTE, ScanGate, scan_window
from fcslam.sources.logs.archive import numbered_lines
from fcslam.sources.logs.dialect import Dialect, Line, OdometryLine, ScanLine
from fcslam.sources.logs.overview import LogReading, Overview
from fcslam.sources.path_summary import PathSummary
from fcslam.sources.pose import pose_array
from fcslam.sources.source import WHOLE, ScanRange, Survey

_LONGEST_RANGE_M = 1e6


class TextLog:
    """A log with one message per line, compressed or not."""

    def __init__(self, path: Path, name: str, dialect: Dialect) -> None:
        self.name = name
        self._path = path
        self._dialect = dialect
        self._audit = Audit()

    @property
    def faults(self) -> Faults:
        """As in Source."""
        return self._audit.faults()

    def survey(self, scans: ScanRange = WHOLE) -> Survey:
        """As in Source; the whole log is read once."""
        if scans == WHOLE:
            return self._reading.survey
        audit, track = Audit(), PathSummary()
        for _, line in self._entries(scans, audit):
            if isinstance(line, ScanLine):
                track.add(line.stamp, line.T_odom_base)
        return Survey(track.count, track.duration_s, track.length_m, self._reading.survey.laser, audit.faults())

    def records(self, scans: ScanRange = WHOLE) -> Iterator[SensorRecord]:
        """As in Source."""
        audit = self._audit = Audit()
        laser = self._reading.survey.laser
        for number, line in self._entries(scans, audit):
            T_odom_base = pose_array(line.T_odom_base)
            if isinstance(line, OdometryLine):
                yield Odometry(line.stamp, T_odom_base)
                continue
            try:
                ranges_m = _ranges(line, self._dialect.metres_per_range_unit, number, audit)
            except ValueError:
                audit.add(Fault.BROKEN_LINE, number)
            else:
                yield LaserScan(line.stamp, ranges_m, laser, T_odom_base)

    @cached_property
    def _reading(self) -> LogReading:
        """Summary from one pass over the whole log; rejects a log that cannot be mapped."""
        audit = Audit()
        overview = Overview()
        gate = ScanGate(self._usual_beam_count(), audit)
        for number, line in self._lines(audit):
            if isinstance(line, ScanLine):
                if not gate.admits(number, line):
                    continue
                self._note_clock(number, audit)
            overview.add(line)
        return overview.conclude(self._path, audit.faults())

    def _usual_beam_count(self) -> int:
        audit = Audit()
        scans = (line for _, line in self._lines(audit) if isinstance(line, ScanLine))
        counts = Counter(scan.beam_count for scan in islice(scans, SCANS_THAT_VOTE))
        if not counts:
            seen = f"; {audit.faults()}" if audit.faults() else ""
            raise SourceError(f"{self._path}: no laser scan in this {self._dialect.name}{seen}; give a log with scans")
        return counts.most_common(1)[0][0]

    def _lines(self, audit: Audit) -> Iterator[tuple[int, Line]]:
        parse = self._dialect.parser()
        for number, text in numbered_lines(self._path):
            try:
                line = parse(text)
            except ValueError:
                audit.add(Fault.BROKEN_LINE, number)
                continue
            if line is not None:
                yield number, line

    def _entries(self, scans: ScanRange, audit: Audit) -> Iterator[tuple[int, ScanLine | OdometryLine]]:
        """Scans and odometry of the range, with the poses to use; afterwards ``audit`` holds the range's faults."""
        for number, line in scan_window(self._posed(audit), scans, lambda line: isinstance(line, ScanLine), audit):
            if isinstance(line, ScanLine):
                self._note_clock(number, audit)
            yield number, line

    def _posed(self, audit: Audit) -> Iterator[tuple[int, ScanLine | OdometryLine]]:
        reading = self._reading
        gate = ScanGate(reading.survey.beam_count, audit)
        latest = None
        for number, line in self._lines(audit):
            if isinstance(line, OdometryLine):
                latest = line
                yield number, line
            elif isinstance(line, ScanLine) and gate.admits(number, line):
                late = latest if reading.pose_from_odometry else None
                yield number, line if late is None else line._replace(T_odom_base=late.T_odom_base)

    def _note_clock(self, number: int, audit: Audit) -> None:
        if not self._dialect.timed:
            audit.add(Fault.NO_STAMP, number)


def _ranges(scan: ScanLine, metres_per_unit: float, number: int, audit: Audit) -> Ranges:
    """Ranges in metres, shape (beam_count,), invalid ones NaN; raises ValueError if one is not a number."""
    values = np.array(scan.range_text.split(), dtype=np.float64) * metres_per_unit
    if not (values.min() >= 0.0 and values.max() < _LONGEST_RANGE_M):
        finite, negative = np.isfinite(values), values < 0.0
        for kind, count in (
            (Fault.NON_FINITE_RANGE, np.count_nonzero(~finite)),
            (Fault.NEGATIVE_RANGE, np.count_nonzero(negative & finite)),
        ):
            if count:
                audit.add(kind, number, int(count))
        values = np.where(finite & ~negative, np.minimum(values, _LONGEST_RANGE_M), nan)
    ranges: Ranges = values.astype(np.float32)
    ranges.setflags(write=False)
    return ranges
