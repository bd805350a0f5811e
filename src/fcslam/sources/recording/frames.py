"""Reads the frames of a recording's files and merges them into the order in which they were written."""

import heapq
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from fcslam.errors import SourceError
from fcslam.sources.faults import Fault
from fcslam.sources.pose import Pose
from fcslam.sources.recording.layout import HEADER_BYTES, META, SCANS, FrameFile, is_whole

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
        """The odometry; all NaN for an image without odometry."""
        x, y, theta = self.content["T_odom_base"].tolist()
        return x, y, theta

    @property
    def beam_count(self) -> int:
        """Ranges in the scan."""
        return len(self.content["ranges_m"])


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
    try:
        if not path.is_file():
            raise SourceError(f"{path}: is missing; copy the whole folder again")
        with path.open("rb") as stream:
            header = stream.read(HEADER_BYTES)
            if header != file.header:
                raise SourceError(f"{path}: does not fit {META} (its header is another one); copy both again")
            for block in iter(partial(stream.read, _BLOCK_FRAMES * file.frame_bytes), b""):
                view = memoryview(block)
                for start in range(0, len(view), file.frame_bytes):
                    yield view[start : start + file.frame_bytes]
    except OSError as error:
        raise SourceError(f"{path}: cannot be read ({error}); check the file and its permissions") from error
