"""Reads the frames of a recording's files and merges them into the order in which they were written."""

import heapq
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from math import isnan
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple
from zlib import crc32

import numpy as np

from fcslam.errors import SourceError
from fcslam.records import Beams, LaserModel, Ranges, Sweep
from fcslam.sources.faults import Fault
from fcslam.sources.pose import UNKNOWN_POSE, Pose
from fcslam.sources.recording.layout import (
    HEADER_BYTES,
    META,
    RANGE,
    SCANS,
    FrameFile,
    check_beams,
    check_sweep,
    is_whole,
)
from fcslam.untrusted import open_file

_BLOCK_FRAMES = 256


class Frame(NamedTuple):
    """One record of a file."""

    sequence: int
    """Position in the recording; a damaged frame has that of the frame before it."""
    file: FrameFile
    number: int
    """Counts the file's frames from 1."""
    content: Any
    """The fields of ``file.frame``; None if damaged."""
    fault: Fault | None = None

    @property
    def is_scan(self) -> bool:
        """Whether it holds a scan."""
        return self.file.name == SCANS

    @property
    def stamp(self) -> float:
        """Seconds of the recording's clock."""
        return float(self.content["stamp"])

    @property
    def T_odom_base(self) -> Pose:
        """The odometry; ``UNKNOWN_POSE`` of a scan or an image without odometry."""
        x, y, theta = self.content["T_odom_base"].tolist()
        return UNKNOWN_POSE if isnan(x) and isnan(y) and isnan(theta) else (x, y, theta)

    @property
    def laser(self) -> int:
        """Index of the scan's laser."""
        return int(self.content["laser"])

    def beams(self, lasers: Sequence[LaserModel]) -> Beams:
        """The scan's beams; raises ValueError if it has no laser of the recording or no sane beams."""
        if not self.laser < len(lasers):
            raise ValueError("no laser of this recording")
        beam_count, *angles_rad = (self.content[name].item() for name in Beams._fields)
        beams = Beams(beam_count, *angles_rad)
        check_beams(beams)
        return beams

    def sweep(self) -> Sweep | None:
        """The scan's sweep; None: all beams were measured at the stamp. Raises ValueError if it is not sane."""
        first_s, last_s, vx, vy, vtheta, ax, ay, atheta = numbers = self.content["sweep"].tolist()
        if all(map(isnan, numbers)):
            return None
        sweep = Sweep(first_s, last_s, (vx, vy, vtheta), (ax, ay, atheta))
        check_sweep(sweep)
        return sweep

    def ranges_m(self, file: BinaryIO) -> Ranges:
        """Ranges of the scan in metres, from the file of ranges; raises ValueError if they are damaged."""
        offset = int(self.content["offset"])
        if offset >= 1 << 63:
            raise ValueError("no place in a file")
        file.seek(offset)
        content = file.read(RANGE.itemsize * int(self.content["beam_count"]))
        if crc32(content) != self.content["ranges_crc32"]:
            raise ValueError("other ranges")
        return np.frombuffer(content, RANGE).astype(np.float32)


@contextmanager
def opened(path: Path) -> Iterator[BinaryIO]:
    """One of the files of a recording.

    Raises:
        SourceError: it is missing, or cannot be read.
    """
    try:
        if not path.is_file():
            raise SourceError(f"{path}: is missing; copy the whole folder again")
        with open_file(path, path.parent) as file:
            yield file
    except OSError as error:
        raise SourceError(f"{path}: cannot be read ({error}); check the file and its permissions") from error


def merged_frames(folder: Path, files: Sequence[FrameFile]) -> Iterator[Frame]:
    """The frames of all ``files`` of ``folder`` in the order of the recording, including damaged ones.

    Raises:
        SourceError: a file is missing, cannot be read, or does not match the laser or version of meta.yaml.
    """
    yield from heapq.merge(*(_frames(folder / file.name, file) for file in files), key=lambda frame: frame.sequence)


def frame_count(folder: Path, file: FrameFile) -> int:
    """Number of whole frames in ``file`` by its length; 0 if the file is missing."""
    path = folder / file.name
    return max(0, path.stat().st_size - HEADER_BYTES) // file.frame_bytes if path.is_file() else 0


def _frames(path: Path, file: FrameFile) -> Iterator[Frame]:
    sequence = -1
    for number, content in enumerate(_pieces(path, file), start=1):
        if len(content) < file.frame_bytes:
            yield Frame(sequence, file, number, None, Fault.CUT_RECORD)
        elif not is_whole(content):
            yield Frame(sequence, file, number, None, Fault.BROKEN_RECORD)
        else:
            fields = np.frombuffer(content, file.frame)[0]
            sequence = int(fields["sequence"])
            yield Frame(sequence, file, number, fields)


def _pieces(path: Path, file: FrameFile) -> Iterator[memoryview]:
    """The bytes of each frame; the last one may be short."""
    with opened(path) as stream:
        if stream.read(HEADER_BYTES) != file.header:
            raise SourceError(f"{path}: does not fit {META} (its header is another one); copy both again")
        for block in iter(partial(stream.read, _BLOCK_FRAMES * file.frame_bytes), b""):
            view = memoryview(block)
            for start in range(0, len(view), file.frame_bytes):
                yield view[start : start + file.frame_bytes]
