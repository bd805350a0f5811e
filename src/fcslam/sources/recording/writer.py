"""Writes sensor records to a recording folder, one by one. A crash loses the last record at most."""

import os
from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from io import BytesIO, FileIO
from math import nan
from pathlib import Path
from typing import Self
from zlib import crc32

import numpy as np
from pydantic import ValidationError

from fcslam.config import one_line
from fcslam.errors import OutputError
from fcslam.geometry.beams import is_same_laser
from fcslam.records import (
    CameraImage,
    CameraModel,
    GnssFix,
    GroundTruth,
    LaserModel,
    LaserScan,
    Odometry,
    RecordedItem,
)
from fcslam.runs import write_tum
from fcslam.sources.images import check_image, image_suffix
from fcslam.sources.recording.layout import (
    GROUND_TRUTH,
    HEADER_BYTES,
    IMAGES,
    IMAGES_FILE,
    ODOMETRY_FILE,
    RANGE,
    RANGES,
    SCANS_FILE,
    SWEEP_NUMBERS,
    FrameFile,
    Meta,
    check_sweep,
    image_path,
    write_meta,
)

_NO_POSE = (nan, nan, nan)
_NO_SWEEP = (nan,) * SWEEP_NUMBERS


class RecordingWriter:
    """A recording that grows. Nothing is buffered: what ``write`` has returned from outlives this process."""

    def __init__(self, folder: Path, meta: Meta) -> None:
        """Use ``create`` instead."""
        self._folder, self._meta, self._next_sequence = folder, meta, 0
        frames = [SCANS_FILE, ODOMETRY_FILE]
        if meta.camera is not None:
            frames.append(IMAGES_FILE)
            (folder / IMAGES).mkdir(exist_ok=True)
        with ExitStack() as stack:
            self._appenders = {
                name: stack.enter_context(_Appender(folder / name))
                for name in (*(file.name for file in frames), RANGES, GROUND_TRUTH)
            }
            for file in frames:
                self._appenders[file.name].append(file.header)
            self._stack = stack.pop_all()

    @classmethod
    def create(cls, folder: Path, lasers: Sequence[LaserModel], camera: CameraModel | None = None) -> Self:
        """Start a new recording at ``folder``, which must be missing or empty.

        Raises:
            OutputError: the folder is not empty or cannot be written, or a sensor model is invalid.
        """
        try:
            meta = Meta(lasers=tuple(lasers), camera=camera)
        except ValidationError as error:
            reason = one_line(error.errors()[0]["msg"])
            raise OutputError(f"{folder}: cannot hold these sensors ({reason}); correct them") from error
        with _translate_errors(folder):
            folder.mkdir(exist_ok=True)
            if any(folder.iterdir()):
                raise OutputError(f"{folder}: is not empty; choose another place")
            write_meta(folder, meta)
            return cls(folder, meta)

    def write(self, item: RecordedItem) -> None:
        """Append one record.

        Raises:
            OutputError: the record cannot be written, has a stamp, pose or sweep that is not sane, or is of another
                sensor. The pose of a scan may be unknown (NaN).
        """
        self._check(item)
        with _translate_errors(self._folder):
            match item:
                case LaserScan():
                    self._append_scan(item)
                case Odometry(stamp, pose):
                    self._append(ODOMETRY_FILE, stamp, pose)
                case CameraImage():
                    self._append_image(item)
                case GroundTruth(stamp, pose):
                    line = BytesIO()
                    write_tum(line, np.array([stamp]), pose[np.newaxis])
                    self._appenders[GROUND_TRUTH].append(line.getvalue())

    def close(self) -> None:
        """Close the files."""
        self._stack.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _check(self, item: RecordedItem) -> None:
        if isinstance(item, GnssFix):
            raise OutputError(f"{self._folder}: a recording of this kind holds no GNSS fixes; write a bag")
        pose = item.T_building_base if isinstance(item, GroundTruth) else item.T_odom_base
        is_scan = isinstance(item, LaserScan)
        is_sound = pose is None or bool(np.isfinite(pose).all() or (is_scan and np.isnan(pose).all()))
        if not (np.isfinite(item.stamp) and is_sound):
            raise OutputError(f"{self._folder}: a record at {item.stamp} s has no finite stamp or pose; leave it out")
        if isinstance(item, LaserScan):
            if self._index(item.laser) is None:
                what = f"a scan at {item.stamp} s belongs to no laser of the recording"
                raise OutputError(f"{self._folder}: {what}; use one each")
            try:
                if item.sweep is not None:
                    check_sweep(item.sweep)
            except ValueError as error:
                raise OutputError(f"{self._folder}: a scan at {item.stamp} s cannot be kept ({error})") from error
        if isinstance(item, CameraImage):
            if item.camera != self._meta.camera:
                raise OutputError(f"{self._folder}: an image at {item.stamp} s is not of the recording's camera")
            try:
                check_image(item.encoded, item.camera)
            except ValueError as error:
                raise OutputError(f"{self._folder}: an image at {item.stamp} s cannot be kept ({error})") from error

    def _index(self, laser: LaserModel) -> int | None:
        return next((k for k, known in enumerate(self._meta.lasers) if is_same_laser(laser, known)), None)

    def _append_scan(self, scan: LaserScan) -> None:
        """Write the ranges before the frame: a frame without ranges is a fault, ranges without a frame are removed."""
        ranges, content = self._appenders[RANGES], scan.ranges_m.astype(RANGE).tobytes()
        offset = ranges.size
        ranges.append(content)
        place = (*scan.laser.beams, offset, crc32(content))
        sweep = _NO_SWEEP if scan.sweep is None else np.hstack(scan.sweep)
        self._append(SCANS_FILE, scan.stamp, scan.T_odom_base, self._index(scan.laser), *place, sweep)

    def _append(self, frames: FrameFile, *values: object) -> None:
        self._appenders[frames.name].append(frames.packed(self._next_sequence, *values))
        self._next_sequence += 1

    def _append_image(self, image: CameraImage) -> None:
        """Write the file before the frame: a frame without a file is a fault, a file without a frame is overwritten."""
        suffix, encoded = image_suffix(image.encoded), image.encoded
        written = (self._appenders[IMAGES_FILE.name].size - HEADER_BYTES) // IMAGES_FILE.frame_bytes
        image_path(self._folder, written, suffix).write_bytes(encoded)
        pose = _NO_POSE if image.T_odom_base is None else image.T_odom_base
        self._append(IMAGES_FILE, image.stamp, pose, suffix.encode(), len(encoded), crc32(encoded))


def write_recording(
    folder: Path, lasers: Sequence[LaserModel], camera: CameraModel | None, records: Iterable[RecordedItem]
) -> None:
    """Write ``records`` to a new recording folder; equal records give equal bytes.

    Sensor records are lossless; ground truth has nine decimals.

    Raises:
        OutputError: as ``RecordingWriter.create`` and ``write``.
    """
    with RecordingWriter.create(folder, lasers, camera) as writer:
        for record in records:
            writer.write(record)


class _Appender(FileIO):
    """A file that grows by complete records."""

    def __init__(self, path: Path) -> None:
        super().__init__(os.open(path, os.O_RDWR | os.O_CREAT, 0o666), "r+")
        self.size = os.fstat(self.fileno()).st_size

    def append(self, piece: bytes) -> None:
        """Append the whole piece, or undo a partial write (disk full) and raise OSError."""
        written = 0
        try:
            while written < len(piece):
                written += os.pwrite(self.fileno(), piece[written:], self.size + written)
        except OSError:
            self.truncate(self.size)
            raise
        self.size += len(piece)


@contextmanager
def _translate_errors(folder: Path) -> Iterator[None]:
    """Translate OSError to OutputError with a one-line message."""
    try:
        yield
    except OSError as error:
        reason = error.strerror or str(error)
        raise OutputError(
            f"{folder}: cannot be written ({reason}); what was written before can be read, make room or choose "
            "another place"
        ) from error
