"""Reads a recording folder.

Damaged records are skipped and counted: frames with a wrong checksum or an implausible stamp or pose, images whose file
is missing or different, and frames that a crash cut off. Without the camera's calibration, images are ignored and the
rest is read. ``gate`` decides which scans are consistent.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import cached_property, partial
from math import isnan, nan
from pathlib import Path
from typing import BinaryIO
from zlib import crc32

import numpy as np

from fcslam.errors import SourceError
from fcslam.records import (
    CameraImage,
    CameraModel,
    GroundTruth,
    LaserModel,
    LaserScan,
    Odometry,
    Ranges,
    SensorRecord,
    frozen,
)
from fcslam.runs import read_tum
from fcslam.sources.contradictions import ScanWatch
from fcslam.sources.faults import Audit, Fault, Faults
from fcslam.sources.gate import ScanGate, check_consistency, scan_window
from fcslam.sources.images import MAX_IMAGE_BYTES, check_image
from fcslam.sources.path_summary import WITHOUT_ODOMETRY, PathSummary
from fcslam.sources.pose import UNKNOWN_POSE
from fcslam.sources.recording.frames import Frame, frame_count, merged_frames, opened
from fcslam.sources.recording.layout import (
    GROUND_TRUTH,
    IMAGES_FILE,
    META,
    ODOMETRY_FILE,
    RANGES,
    SCANS,
    SCANS_FILE,
    Meta,
    image_path,
    read_meta,
)
from fcslam.sources.source import WHOLE, ScanRange, Survey
from fcslam.untrusted import read_bytes

_MAX_COORDINATE = 1e7
"""Metres, or radians of a heading that was never wrapped."""
_MAX_STAMP_S = 1e12
_audit = partial(Audit, "record")
_SUFFIXES = (b"jpg", b"png")


def is_recording(path: Path, _: bytes) -> bool:
    """Whether there is a recording folder at ``path``."""
    return (path / META).is_file() or (path / SCANS).is_file()


class Recording:
    """A recording folder of one robot."""

    def __init__(self, path: Path, name: str) -> None:
        self.name = name
        self._path = path
        self._audit = _audit()

    @property
    def faults(self) -> Faults:
        """As in Source."""
        return self._audit.faults()

    def survey(self, scans: ScanRange = WHOLE) -> Survey:
        """As in Source; images are not opened."""
        whole = self._survey
        if scans == WHOLE:
            return whole
        track, audit = PathSummary(), _audit()
        for _, frame in self._entries(scans, audit):
            if frame.is_scan:
                track.add(frame.stamp, frame.T_odom_base)
        return replace(
            whole,
            scan_count=track.count,
            duration_s=track.duration_s,
            path_length_m=track.length_m,
            faults=audit.faults(),
        )

    def records(self, scans: ScanRange = WHOLE) -> Iterator[SensorRecord]:
        """As in Source."""
        audit = self._audit = _audit()
        watch = ScanWatch(audit)
        lasers, camera = self._survey.lasers, self._survey.camera
        with opened(self._path / RANGES) as ranges:
            for number, frame in self._entries(scans, audit):
                if frame.is_scan:
                    laser = lasers[frame.laser].with_beams(frame.beams(lasers))
                    try:
                        ranges_m = _ranges(frame, ranges, audit)
                    except ValueError:
                        audit.add(Fault.BROKEN_RECORD, number)
                    else:
                        scan = LaserScan(frame.stamp, ranges_m, laser, frozen(frame.T_odom_base), frame.sweep())
                        watch.add(number, scan)
                        yield scan
                elif frame.file is ODOMETRY_FILE:
                    yield Odometry(frame.stamp, frozen(frame.T_odom_base))
                elif camera is not None:
                    try:
                        image = self._image(frame, camera)
                    except (OSError, ValueError):
                        audit.add(Fault.BROKEN_IMAGE, number)
                    else:
                        yield image

    def ground_truth(self) -> Iterator[GroundTruth]:
        """True poses in the order in which they were written; empty if they were not recorded.

        Raises:
            EvaluationError: ground_truth.tum is damaged.
        """
        path = self._path / GROUND_TRUTH
        if path.is_file() and path.stat().st_size:
            for stamp, pose in zip(*read_tum(path, self._path), strict=True):
                yield GroundTruth(float(stamp), frozen(pose))

    @cached_property
    def _meta(self) -> Meta:
        return read_meta(self._path)

    @cached_property
    def _survey(self) -> Survey:
        """Summary from one pass over the whole recording; rejects a recording that cannot be mapped."""
        audit, scans, odometry, notes = _audit(), PathSummary(), PathSummary(), list[str]()
        with opened(self._path / RANGES):
            pass  # it is there
        for _, frame in self._checked(audit):
            if frame.is_scan:
                if not scans.count and frame.T_odom_base == UNKNOWN_POSE:
                    notes.append(f"{self._path}: {WITHOUT_ODOMETRY}")
                scans.add(frame.stamp, frame.T_odom_base)
            elif frame.file is ODOMETRY_FILE:
                odometry.add(frame.stamp, frame.T_odom_base)
        faults = audit.faults()
        check_consistency(self._path, faults, scans.count, odometry.count)
        if not scans.count:
            seen = f"; {faults}" if faults else ""
            raise SourceError(f"{self._path}: no laser scan in this recording{seen}; give one with scans")
        camera, camera_notes = self._camera_and_notes()
        notes += camera_notes
        return Survey(scans.count, scans.duration_s, scans.length_m, self._meta.lasers, faults, tuple(notes), camera)

    def _camera_and_notes(self) -> tuple[CameraModel | None, tuple[str, ...]]:
        camera, count = self._meta.camera, frame_count(self._path, IMAGES_FILE)
        if camera is None and count:
            return None, (f"{self._path}: no calibration of the camera in {META}, so its {count} images are left out",)
        if camera is not None and not (self._path / IMAGES_FILE.name).is_file():
            return None, (f"{self._path}: {IMAGES_FILE.name} is missing, so the camera's images are left out",)
        return camera, ()

    def _entries(self, scans: ScanRange, audit: Audit) -> Iterator[tuple[int, Frame]]:
        return scan_window(self._checked(audit), scans, lambda frame: frame.is_scan, audit)

    def _checked(self, audit: Audit) -> Iterator[tuple[int, Frame]]:
        """The usable frames, each with its number."""
        lasers = self._meta.lasers
        files = [SCANS_FILE, ODOMETRY_FILE]
        if self._camera_and_notes()[0] is not None:
            files.append(IMAGES_FILE)
        gates = [ScanGate(laser.beams, audit) for laser in lasers]
        for frame in merged_frames(self._path, files):
            if frame.fault is not None or not _is_sane(frame, lasers):
                audit.add(frame.fault or Fault.BROKEN_RECORD, frame.number)
            elif not frame.is_scan or gates[frame.laser].admits(frame.number, frame.stamp, frame.beams(lasers)):
                yield frame.number, frame

    def _image(self, frame: Frame, camera: CameraModel) -> CameraImage:
        """Raises OSError or ValueError if the image's file is missing or different."""
        size, suffix = int(frame.content["size"]), bytes(frame.content["suffix"])
        if suffix not in _SUFFIXES or size > MAX_IMAGE_BYTES:
            raise ValueError("no image of this kind")
        path = image_path(self._path, frame.number - 1, suffix.decode())
        encoded = read_bytes(path, self._path, MAX_IMAGE_BYTES)
        if len(encoded) != size or crc32(encoded) != frame.content["file_crc32"]:
            raise ValueError("another file")
        check_image(encoded, camera)
        pose = frame.T_odom_base
        return CameraImage(frame.stamp, encoded, camera, None if isnan(pose[0]) else frozen(pose))


def _is_sane(frame: Frame, lasers: Sequence[LaserModel]) -> bool:
    try:
        if frame.is_scan:
            frame.beams(lasers)
            frame.sweep()
    except ValueError:
        return False
    pose = frame.T_odom_base
    unknown = pose == UNKNOWN_POSE and frame.file is not ODOMETRY_FILE
    return abs(frame.stamp) < _MAX_STAMP_S and (unknown or all(abs(value) < _MAX_COORDINATE for value in pose))


def _ranges(frame: Frame, file: BinaryIO, audit: Audit) -> Ranges:
    """Ranges in metres, shape (beam_count,); negative ones become NaN. Raises ValueError if they are damaged."""
    ranges = frame.ranges_m(file)
    negative = ranges < 0.0
    if negative.any():
        audit.add(Fault.NEGATIVE_RANGE, frame.number, int(np.count_nonzero(negative)))
        ranges[negative] = nan
    return frozen(ranges, np.float32)
