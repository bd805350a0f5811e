"""Reads a CARMEN log into arrays, once; surveys and records come from these.

Besides the rules of ``gate``:

- Scans without stamps get stamps 1 s apart, and are counted.
- If only the poses of odometry messages change, a scan takes the pose of the message before it.
- Poses that say nothing (``PathSummary.fault``) are not odometry.
"""

from collections.abc import Iterator
from functools import cached_property
from pathlib import Path
from typing import NamedTuple

from fcslam.errors import SourceError
from fcslam.records import Beams, FloatArray, LaserScan, Odometry, SensorRecord, frozen
from fcslam.sources.contradictions import ScanWatch
from fcslam.sources.faults import Audit, Fault, Faults
from fcslam.sources.gate import FIRST_MESSAGES, ScanGate, check_consistency
from fcslam.sources.logs.carmen import BROKEN, SICK_MAX_RANGE_M, CarmenArrays
from fcslam.sources.logs.laser import laser_model, usual_log_beams
from fcslam.sources.path_summary import PathSummary, without_odometry
from fcslam.sources.pose import UNKNOWN_POSE, pose_of
from fcslam.sources.returns import RangeSample, placeholder_note, without
from fcslam.sources.source import Survey


class _Reading(NamedTuple):
    survey: Survey
    pose_from_odometry: bool
    """Whether scans take the pose of the latest odometry message, because their own never changes."""
    has_odometry: bool
    placeholders: tuple[float, ...]


class CarmenLog:
    """A log with one message per line, compressed or not."""

    def __init__(self, path: Path, name: str) -> None:
        self.name = name
        self._path = path
        self._audit = Audit()

    @property
    def faults(self) -> Faults:
        """As in Source."""
        return self._audit.faults()

    def survey(self) -> Survey:
        """As in Source."""
        return self._reading.survey

    def records(self) -> Iterator[SensorRecord]:
        """As in Source."""
        audit = self._audit = Audit()
        watch, log, reading = ScanWatch(audit), self._log, self._reading
        (laser,) = reading.survey.lasers
        for number, k, T_odom_base in self._posed(audit):
            if k < 0:
                if reading.has_odometry:
                    yield Odometry(log.odometry_stamps[~k], T_odom_base)
                continue
            if k in log.untimed:
                audit.add(Fault.NO_STAMP, number)
            ranges_m = log.ranges_m[k]
            if invalid := log.invalid.get(k):
                audit.add(Fault.INVALID_RANGE, number, invalid)
            beams = log.beams_of(k, laser.beams)
            assert beams is not None  # as the gate says
            ranges_m = without(ranges_m, reading.placeholders)
            scan = LaserScan(log.stamps[k], ranges_m, laser.with_beams(beams), T_odom_base)
            watch.add(number, scan)
            yield scan
        self.__dict__.pop("_log", None)  # whoever maps a recording reads its records once

    @cached_property
    def _log(self) -> CarmenArrays:
        return CarmenArrays(self._path)

    @cached_property
    def _reading(self) -> _Reading:
        path, log, audit, driven = self._path, self._log, Audit(), PathSummary()
        sample = RangeSample(len(log.stamps))
        if not log.stamps:
            list(self._consistent(Beams(0, 0.0, 0.0), audit))
            seen = f"; {audit.faults()}" * bool(audit.faults())
            raise SourceError(f"{path}: no laser scan in this CARMEN log{seen}; give a log with scans")
        admitted: list[int] = []
        for number, k in self._consistent(usual_log_beams(log, FIRST_MESSAGES), audit):
            if k < 0:
                continue
            if k in log.untimed:
                audit.add(Fault.NO_STAMP, number)
            T_odom_base, stated = pose_of(log.T_odom_base[k]), log.stated[k]
            sample.add(T_odom_base, log.ranges_m[k], 0.0, SICK_MAX_RANGE_M if stated is None else stated.max_range_m)
            driven.add(log.stamps[k], T_odom_base)
            admitted.append(k)
        faults, scan_count, duration_s = audit.faults(), driven.count, driven.duration_s
        check_consistency(path, faults, scan_count, len(log.odometry))
        if problem := sample.problem("", "the unit of the ranges"):
            raise SourceError(f"{path}: {problem}")
        pose_from_odometry = not driven.moves and bool((log.odometry != log.odometry[:1]).any())
        if pose_from_odometry:
            driven = PathSummary()
            for stamp, pose in zip(log.odometry_stamps, log.odometry, strict=True):
                driven.add(stamp, pose_of(pose))
        # a line that states the angles says more
        telling = next((k for k in admitted if log.stated[k] is not None), admitted[0])
        laser = laser_model(log, telling, admitted)
        alone = without_odometry(duration_s / max(1, scan_count - 1))
        notes = [f"the odometry {driven.fault}; it is not used", alone] if driven.fault else []
        placeholders = sample.placeholders()
        survey = Survey(
            scan_count,
            duration_s,
            driven.length_m,
            (laser,),
            faults,
            (*(f"{path}: {note}" for note in notes), *placeholder_note(path, placeholders, "")),
        )
        return _Reading(survey, pose_from_odometry, driven.fault is None, placeholders)

    def _posed(self, audit: Audit) -> Iterator[tuple[int, int, FloatArray]]:
        """Lines of consistent scans and odometry, what they hold as in ``CarmenArrays.contents``, and T_odom_base."""
        log, reading = self._log, self._reading
        unknown: FloatArray = frozen(UNKNOWN_POSE)
        latest: FloatArray | None = None
        for number, k in self._consistent(reading.survey.lasers[0].beams, audit):
            pose = log.odometry[~k] if k < 0 else log.T_odom_base[k]
            if k < 0:
                latest = pose if reading.pose_from_odometry else None
            elif not reading.has_odometry:
                pose = unknown
            elif latest is not None:
                pose = latest
            yield number, k, pose

    def _consistent(self, declared: Beams, audit: Audit) -> Iterator[tuple[int, int]]:
        """Lines and their contents, without broken ones and scans that are not consistent."""
        log, gate = self._log, ScanGate(declared, audit)
        for number, k in zip(log.numbers, log.contents, strict=True):
            if k == BROKEN:
                audit.add(Fault.BROKEN_LINE, number)
            elif k < 0 or gate.admits(number, log.stamps[k], log.beams_of(k, declared)):
                yield number, k
