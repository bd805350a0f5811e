"""Reads a CARMEN log: surveys it once, then streams its records.

Besides the rules of ``gate``:

- Scans without stamps get stamps 1 s apart, and are counted.
- If only the poses of odometry messages change, a scan takes the pose of the message before it.
- Poses that say nothing (``PathSummary.fault``) are not odometry.
"""

from collections.abc import Iterable, Iterator
from functools import cached_property
from math import isnan
from pathlib import Path
from typing import NamedTuple

import numpy as np

from fcslam.errors import SourceError
from fcslam.records import Beams, FloatArray, LaserScan, Odometry, SensorRecord, frozen
from fcslam.sources.contradictions import ScanWatch
from fcslam.sources.faults import Audit, Fault, Faults
from fcslam.sources.gate import FIRST_MESSAGES, ScanGate, check_consistency, scan_window
from fcslam.sources.logs.archive import head, numbered_lines
from fcslam.sources.logs.carmen import SICK_MAX_RANGE_M, CarmenParser, Line, OdometryLine, ScanLine, is_raw
from fcslam.sources.logs.laser import MountingEstimate, beams_of, laser_model, usual_log_beams
from fcslam.sources.path_summary import WITHOUT_ODOMETRY, PathSummary, check_units
from fcslam.sources.pose import UNKNOWN_POSE
from fcslam.sources.returns import RangeSample, placeholder_note, without
from fcslam.sources.source import WHOLE, ScanRange, Survey

KEPT_BYTES = 1 << 25
"""So that memory does not grow with the length of a log."""

NumberedLine = tuple[int, Line | None]
"""A line with its number, counted from 1; None if it is broken."""
UNTIMED_STEP_S = 1.0
"""Time between the scans of a log that states none."""


class _Reading(NamedTuple):
    survey: Survey
    pose_from_odometry: bool
    """Whether scans take the pose of the latest odometry message, because their own never changes."""
    has_odometry: bool
    placeholders: tuple[float, ...]


class CarmenLog:
    """A log with one message per line, compressed or not."""

    def __init__(self, path: Path, name: str, kept_bytes: int = KEPT_BYTES) -> None:
        """A log with more than ``kept_bytes`` is decompressed and parsed again in each pass."""
        self.name, self._kept_bytes = name, kept_bytes
        self._path = path
        self._audit = Audit()
        self._kept: list[NumberedLine] = []
        """All lines, once a short log was read to its end and until all its records were."""
        self._parameters: dict[str, str] = {}
        """Settings of the robot in the lines that were read."""

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
            if isinstance(entry, ScanLine):
                track.add(entry.stamp, entry.T_odom_base)
        return Survey(track.count, track.duration_s, track.length_m, self._reading.survey.lasers, audit.faults())

    def records(self, scans: ScanRange = WHOLE) -> Iterator[SensorRecord]:
        """As in Source."""
        audit = self._audit = Audit()
        watch = ScanWatch(audit)
        (laser,) = self._reading.survey.lasers
        for number, entry in self._entries(scans, self._all_lines(), audit):
            T_odom_base: FloatArray = frozen(entry.T_odom_base)
            if isinstance(entry, OdometryLine):
                if self._reading.has_odometry:
                    yield Odometry(entry.stamp, T_odom_base)
                continue
            ranges_m = entry.ranges_m
            if invalid := int(np.count_nonzero(np.isnan(ranges_m))):
                audit.add(Fault.INVALID_RANGE, number, invalid)
            ranges_m = without(ranges_m, self._reading.placeholders)
            beams = beams_of(entry, laser.beams)
            assert beams is not None  # as the gate says
            scan = LaserScan(entry.stamp, ranges_m, laser.with_beams(beams), T_odom_base)
            watch.add(number, scan)
            yield scan
        self._kept = []  # whoever maps a recording reads its records once

    @cached_property
    def _reading(self) -> _Reading:
        audit, sample, mounting = Audit(), RangeSample(), MountingEstimate()
        scans, odometry = PathSummary(), PathSummary()
        declared = self._first_look()
        gate = ScanGate(declared, audit)
        telling: ScanLine | None = None
        for number, line in _sound(self._all_lines(), audit):
            if isinstance(line, OdometryLine):
                odometry.add(line.stamp, line.T_odom_base)
            elif gate.admits(number, line.stamp, beams_of(line, declared)):
                _note_clock(number, line, audit)
                if sample.wants(line.T_odom_base):
                    max_range_m = line.stated.max_range_m if line.stated is not None else SICK_MAX_RANGE_M
                    sample.add(line.T_odom_base, line.ranges_m, 0.0, max_range_m)
                scans.add(line.stamp, line.T_odom_base)
                mounting.add(line)
                if telling is None or (telling.stated is None and line.stated is not None):
                    telling = line  # a line that states the angles says more
        assert telling is not None  # the first scans have the beams that the gate admits
        path, faults = self._path, audit.faults()
        check_consistency(path, faults, scans.count, odometry.count)
        sample.check(path, "", "the unit of the ranges")
        pose_from_odometry = not scans.moves and odometry.moves
        driven = odometry if pose_from_odometry else scans
        check_units(path, driven)
        laser = laser_model(telling, self._parameters, mounting)
        notes = [f"the odometry {driven.fault}; it is not used", WITHOUT_ODOMETRY] if driven.fault else []
        placeholders = sample.placeholders()
        survey = Survey(
            scans.count,
            scans.duration_s,
            driven.length_m,
            (laser,),
            faults,
            (*(f"{path}: {note}" for note in notes), *placeholder_note(path, placeholders, "")),
        )
        return _Reading(survey, pose_from_odometry, driven.fault is None, placeholders)

    def _first_look(self) -> Beams:
        audit, scans = Audit(), list[ScanLine]()
        for _, line in _sound(self._all_lines(), audit):
            if isinstance(line, ScanLine):
                scans.append(line)
            if len(scans) == FIRST_MESSAGES:
                break
        if not scans:
            seen = f"; {audit.faults()}" if audit.faults() else ""
            raise SourceError(f"{self._path}: no laser scan in this CARMEN log{seen}; give a log with scans")
        return usual_log_beams(scans, self._parameters)

    def _all_lines(self) -> Iterable[NumberedLine]:
        return self._kept or self._parsed()

    def _parsed(self) -> Iterator[NumberedLine]:
        parse = CarmenParser(is_raw(head(self._path)))
        self._parameters = parse.parameters
        kept, size, untimed = list[NumberedLine](), 0, 0
        for number, text in numbered_lines(self._path):
            try:
                line = parse(text)
                if line is None:
                    continue
                if isinstance(line, ScanLine) and isnan(line.stamp):
                    line = line._replace(stamp=untimed * UNTIMED_STEP_S, is_timed=False)
                    untimed += 1
                elif isinstance(line, OdometryLine) and isnan(line.stamp):
                    line = line._replace(stamp=untimed * UNTIMED_STEP_S)
            except ValueError:
                line = None
            size += len(text)
            if size <= self._kept_bytes:
                kept.append((number, line))
            yield number, line
        if size <= self._kept_bytes:
            self._kept = kept

    def _entries(self, scans: ScanRange, lines: Iterable[NumberedLine], audit: Audit) -> Iterator[tuple[int, Line]]:
        """The lines with the poses of the scans."""
        for number, entry in scan_window(
            self._posed(lines, audit), scans, lambda entry: isinstance(entry, ScanLine), audit
        ):
            if isinstance(entry, ScanLine):
                _note_clock(number, entry, audit)
            yield number, entry

    def _posed(self, lines: Iterable[NumberedLine], audit: Audit) -> Iterator[tuple[int, Line]]:
        reading = self._reading
        declared = reading.survey.lasers[0].beams
        gate = ScanGate(declared, audit)
        latest = None
        for number, line in _sound(lines, audit):
            if isinstance(line, OdometryLine):
                latest = line
                yield number, line
            elif gate.admits(number, line.stamp, beams_of(line, declared)):
                late = latest if reading.pose_from_odometry else None
                pose = (late or line).T_odom_base if reading.has_odometry else UNKNOWN_POSE
                yield number, line._replace(T_odom_base=pose)


def _note_clock(number: int, line: ScanLine, audit: Audit) -> None:
    if not line.is_timed:
        audit.add(Fault.NO_STAMP, number)


def _sound(lines: Iterable[NumberedLine], audit: Audit) -> Iterator[tuple[int, Line]]:
    for number, line in lines:
        if line is None:
            audit.add(Fault.BROKEN_LINE, number)
        else:
            yield number, line
