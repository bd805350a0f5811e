"""Reads a text log: surveys it once, then streams its records.

Besides the rules of ``gate``:

- Scans of a dialect without stamps get stamps 1 s apart, and are counted.
- If only the poses of odometry messages change, a scan takes the pose of the message before it.
- Poses that say nothing (``PathSummary.fault``) are not odometry.
"""

from collections import Counter
from collections.abc import Iterable, Iterator
from contextlib import suppress
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import NamedTuple

from fcslam.config import one_line
from fcslam.errors import SourceError
from fcslam.records import Beams, LaserScan, Odometry, Ranges, SensorRecord
from fcslam.sources.contradictions import OdometryWatch
from fcslam.sources.faults import Audit, Fault, Faults
from fcslam.sources.gate import SCANS_THAT_VOTE, ScanGate, scan_window
from fcslam.sources.logs.archive import numbered_lines
from fcslam.sources.logs.dialect import Dialect, Line, OdometryLine, ParameterLine, ScanLine
from fcslam.sources.logs.laser import SICK_MAX_RANGE_M, Interleaving, LogBeams, first_beams
from fcslam.sources.logs.overview import LogReading, Overview
from fcslam.sources.logs.ranges import NumberedLine, parse_ahead, parse_ranges
from fcslam.sources.path_summary import PathSummary
from fcslam.sources.pose import UNKNOWN_POSE, Pose, pose_array
from fcslam.sources.returns import RangeSample, placeholder_note, without
from fcslam.sources.source import WHOLE, ScanRange, Survey

KEPT_BYTES = 1 << 25
"""A log with more bytes is decompressed and parsed again in each pass, so that memory does not grow with its length."""


_WORDS_NAMED, _LONGEST_WORD = 5, 20


class _Scan(NamedTuple):
    """A scan that the gate admits."""

    line: ScanLine
    beams: Beams
    T_odom_base: Pose
    """The pose to use."""


class TextLog:
    """A log with one message per line, compressed or not."""

    def __init__(self, path: Path, name: str, dialect: Dialect) -> None:
        self.name = name
        self._path = path
        self._dialect = dialect
        self._audit = Audit()
        self._kept: list[NumberedLine] = []
        """All lines, once a short log was read to its end and until all its records were."""

    @property
    def faults(self) -> Faults:
        """As in Source."""
        return self._audit.faults()

    def survey(self, scans: ScanRange = WHOLE) -> Survey:
        """As in Source; the whole log is read once."""
        if scans == WHOLE:
            return self._reading.survey
        audit, track = Audit(), PathSummary()
        for _, entry in self._entries(scans, self._all_lines(), audit):
            if isinstance(entry, _Scan):
                track.add(entry.line.stamp, entry.T_odom_base)
        return Survey(track.count, track.duration_s, track.length_m, self._reading.survey.lasers, audit.faults())

    def records(self, scans: ScanRange = WHOLE) -> Iterator[SensorRecord]:
        """As in Source."""
        audit = self._audit = Audit()
        watch = OdometryWatch(audit)
        (laser,) = self._reading.survey.lasers
        unit = self._dialect.metres_per_range_unit
        for number, entry in self._entries(scans, parse_ahead(self._all_lines(), unit), audit):
            T_odom_base = pose_array(entry.T_odom_base)
            if isinstance(entry, OdometryLine):
                if self._reading.has_odometry:
                    yield Odometry(entry.stamp, T_odom_base)
                continue
            model = laser.with_beams(entry.beams)
            ranges_m: Ranges | None
            try:
                ranges_m = parse_ranges(entry.line, unit, number, audit)
            except ValueError:
                ranges_m = None
            if ranges_m is None or len(ranges_m) != model.beam_count:
                audit.add(Fault.BROKEN_LINE, number)
                continue
            ranges_m = without(ranges_m, self._reading.placeholders)
            scan = LaserScan(entry.line.stamp, ranges_m, model, T_odom_base)
            watch.add(number, scan)
            yield scan
        self._kept = []  # whoever maps a recording reads its records once

    @cached_property
    def _reading(self) -> LogReading:
        """Summary from one pass over the whole log; rejects a log that cannot be mapped."""
        audit = Audit()
        overview, sample = Overview(), RangeSample()
        declared, interleaving = self._first_look()
        gate, log_beams = ScanGate(declared, audit), LogBeams(declared, interleaving)
        for number, line in _sound(self._all_lines(), audit):
            if isinstance(line, ScanLine):
                if not gate.admits(number, line.stamp, log_beams.of(line)):
                    continue
                _note_clock(number, line, audit)
                self._sample(sample, line)
            overview.add(line)
        reading = overview.conclude(self._path, audit.faults(), interleaving)
        sample.check(self._path, "", "the unit of the ranges")
        placeholders = sample.placeholders()
        notes = (*reading.survey.notes, *placeholder_note(self._path, placeholders, ""))
        return reading._replace(survey=replace(reading.survey, notes=notes), placeholders=placeholders)

    def _sample(self, sample: RangeSample, line: ScanLine) -> None:
        if not sample.wants(line.T_odom_base):
            return
        max_range_m = line.stated.max_range_m if line.stated is not None else SICK_MAX_RANGE_M
        with suppress(ValueError):
            ranges_m = parse_ranges(line, self._dialect.metres_per_range_unit, 0, Audit())
            sample.add(line.T_odom_base, ranges_m, 0.0, max_range_m)

    def _first_look(self) -> tuple[Beams, Interleaving | None]:
        """The usual beams of the first scans, and whether they interleave."""
        audit, scans, parameters = Audit(), list[ScanLine](), dict[str, str]()
        for _, line in _sound(self._all_lines(), audit):
            if isinstance(line, ParameterLine):
                parameters[line.name] = line.value
            elif isinstance(line, ScanLine):
                scans.append(line)
            if len(scans) == SCANS_THAT_VOTE:
                break
        if not scans:
            seen = f"; {audit.faults()}" if audit.faults() else ""
            raise SourceError(
                f"{self._path}: no laser scan in this {self._dialect.name}{seen}; its lines are {self._kinds()}; "
                "give a log with scans"
            )
        return first_beams(scans, parameters)

    def _kinds(self) -> str:
        """The most common first words of the lines, with their numbers."""
        words = (text.split(None, 1)[:1] for _, text in numbered_lines(self._path))
        counts = Counter(word[0][:_LONGEST_WORD].decode("ascii", "replace") for word in words if word)
        return ", ".join(f"{count} {one_line(word)}" for word, count in counts.most_common(_WORDS_NAMED))

    def _all_lines(self) -> Iterable[NumberedLine]:
        return self._kept or self._parsed()

    def _parsed(self) -> Iterator[NumberedLine]:
        """Parse the log line by line; keeps the lines of a short log for the next pass."""
        parse = self._dialect.parser()
        kept, size = list[NumberedLine](), 0
        for number, text in numbered_lines(self._path):
            try:
                line = parse(text)
                if line is None:
                    continue
            except ValueError:
                line = None
            size += len(text)
            if size <= KEPT_BYTES:
                kept.append((number, line))
            yield number, line
        if size <= KEPT_BYTES:
            self._kept = kept

    def _entries(
        self, scans: ScanRange, lines: Iterable[NumberedLine], audit: Audit
    ) -> "Iterator[tuple[int, _Scan | OdometryLine]]":
        """Scans and odometry of the range, with the poses to use; afterwards ``audit`` holds the range's faults."""
        for number, entry in scan_window(
            self._posed(lines, audit), scans, lambda entry: isinstance(entry, _Scan), audit
        ):
            if isinstance(entry, _Scan):
                _note_clock(number, entry.line, audit)
            yield number, entry

    def _posed(self, lines: Iterable[NumberedLine], audit: Audit) -> "Iterator[tuple[int, _Scan | OdometryLine]]":
        reading = self._reading
        declared = reading.survey.lasers[0].beams
        gate, log_beams = ScanGate(declared, audit), LogBeams(declared, reading.interleaving)
        latest = None
        for number, line in _sound(lines, audit):
            if isinstance(line, OdometryLine):
                latest = line
                yield number, line
            elif isinstance(line, ScanLine):
                beams = log_beams.of(line)
                if gate.admits(number, line.stamp, beams) and beams is not None:
                    late = latest if reading.pose_from_odometry else None
                    pose = (late or line).T_odom_base if reading.has_odometry else UNKNOWN_POSE
                    yield number, _Scan(line, beams, pose)


def _note_clock(number: int, line: ScanLine, audit: Audit) -> None:
    if not line.is_timed:
        audit.add(Fault.NO_STAMP, number)


def _sound(lines: Iterable[NumberedLine], audit: Audit) -> Iterator[tuple[int, Line]]:
    """The lines that are not broken; counts the others."""
    for number, line in lines:
        if line is None:
            audit.add(Fault.BROKEN_LINE, number)
        else:
            yield number, line
