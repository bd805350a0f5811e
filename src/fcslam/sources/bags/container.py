"""The files of a bag: one, several that are parts of one recording, or those of a folder."""

import os
import shutil
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path
from tempfile import mkdtemp
from typing import NamedTuple
from weakref import finalize

from fcslam.config import one_line
from fcslam.errors import SourceError
from fcslam.sources.bags.codec import NANOSECONDS, TRANSFORM_KINDS
from fcslam.sources.bags.records import MCAP_MAGIC, ROS1_MAGIC, SQLITE_MAGIC, DatabaseFile, RecordFile
from fcslam.sources.logs.archive import translate_errors
from fcslam.untrusted import ZSTD, open_file, open_unpacked

_METADATA, _ZSTD_SUFFIX = "metadata.yaml", ".zstd"
_SUFFIXES = (".mcap", ".db3", ".bag", ".active")
_REMEDIES = {
    ROS1_MAGIC: "copy it again, or mend it with `rosbag reindex`",
    MCAP_MAGIC: "copy it again, or mend it with `mcap recover`",
    SQLITE_MAGIC: "copy it again, or mend it with `ros2 bag reindex`",
}
_LONGEST_PAUSE_NS, _LONGEST_OVERLAP_NS = 60 * NANOSECONDS, NANOSECONDS
"""Limits of the time between the scans of two parts of one recording."""


class Topic(NamedTuple):
    """A topic of a bag."""

    name: str
    type: str
    """Without ``msg/``, as ROS 1 writes it."""
    message_count: int


def is_transforms(topic: Topic) -> bool:
    """Whether the topic carries tf."""
    return topic.type in TRANSFORM_KINDS


def is_bag(path: Path, head: bytes) -> bool:
    """Whether there is a bag at ``path``, a file that starts with ``head`` or a folder."""
    if path.is_dir():
        return any(_files_in(path))
    return head.startswith(tuple(_REMEDIES))


def parts_of(path: Path) -> tuple[Path, ...]:
    """The files of one recording: those in a folder or in its folders, or several joined by commas; else the path."""
    if os.path.isdir(path):
        with translate_errors(path):
            return tuple(_files_in(path)) or (path,)
    names = str(path).split(",")
    return (path,) if os.path.lexists(path) or not all(names) else tuple(map(Path, names))


def _files_in(folder: Path) -> list[Path]:
    if files := _own_files(folder):
        return files
    return [file for inner in sorted(folder.iterdir()) if inner.is_dir() for file in _own_files(inner)]


def _own_files(folder: Path) -> list[Path]:
    shown = {path.name for path in folder.iterdir() if not path.name.startswith(".")}
    bags = [name for name in sorted(shown) if Path(name.removesuffix(_ZSTD_SUFFIX)).suffix in _SUFFIXES]
    is_unpacked = {name + _ZSTD_SUFFIX for name in shown}
    return [folder / name for name in bags if name not in is_unpacked]


class BagPart:
    """One file of a bag."""

    def __init__(self, path: Path) -> None:
        """Look at the first bytes of the file; one that is compressed by zstd is unpacked."""
        self.path = path
        with translate_errors(path):
            if (path.parent / _METADATA).is_file():  # a bag from somebody else
                open_file(path, path.parent).close()
            with open_file(path) as file:
                head = file.read(len(SQLITE_MAGIC))
            if path.suffix == _ZSTD_SUFFIX and head.startswith(ZSTD):
                path = self._unpack(path)
                with open_file(path) as file:
                    head = file.read(len(SQLITE_MAGIC))
        self._remedy = next((_REMEDIES[magic] for magic in _REMEDIES if head.startswith(magic)), "")
        if not self._remedy:
            raise SourceError(
                f"{path}: not a bag, or a compressed one; unpack it first by `gunzip`, `xz -d` or `zstd -d`"
            )
        self.file: RecordFile | DatabaseFile = (
            DatabaseFile(path) if head == SQLITE_MAGIC else RecordFile(path, head.startswith(ROS1_MAGIC))
        )

    def _unpack(self, path: Path) -> Path:
        folder = mkdtemp(prefix="fcslam-")
        finalize(self, shutil.rmtree, folder, ignore_errors=True)
        unpacked = Path(folder, path.stem)
        with open_unpacked(path) as content, unpacked.open("wb") as file:
            shutil.copyfileobj(content, file)
        return unpacked

    @property
    def note(self) -> str:
        """Where the reading ended before the end of the file; empty if it did not."""
        if not self.file.damage:
            return ""
        return f"{self.path}: is cut off or damaged, read up to {self.file.damage}"

    def refusal(self, error: object) -> SourceError:
        """The error of a file that cannot be read."""
        reason = one_line(str(error)).rstrip(".") or type(error).__name__
        return SourceError(f"{self.path}: the bag cannot be read ({reason}); {self._remedy}")

    @contextmanager
    def translated(self) -> Iterator[None]:
        """Translate all errors of a damaged file to SourceError."""
        try:
            yield
        except SourceError:
            raise
        except Exception as error:
            raise self.refusal(error) from error


def open_parts(path: Path) -> tuple[BagPart, ...]:
    """The files of a bag."""
    paths = parts_of(path)
    if len({each.resolve() for each in paths}) < len(paths):
        raise SourceError(f"{path}: a file is given twice; give each part of the recording once")
    parts = tuple(map(BagPart, paths))
    if len({part.file.ros1 for part in parts}) > 1:
        raise SourceError(f"{path}: has bags of ROS 1 and of ROS 2; give the parts of one recording")
    return parts


def check_order(topic: str, scans: Iterable[tuple[Path, int]]) -> None:
    """Check that the scans of a topic in several files, with the times of recording, are those of one recording."""
    left_ns: dict[Path, int] = {}
    for (before, before_ns), (part, time_ns) in pairwise(scans):
        if before == part:
            continue
        left_ns.setdefault(before, before_ns)
        if time_ns - before_ns > _LONGEST_PAUSE_NS:
            raise SourceError(
                f"{part}: begins {(time_ns - before_ns) / 1e9:.0f} s after {before} ends, so they are not parts "
                "of one drive; give each as a recording of its own"
            )
        if time_ns - left_ns.get(part, time_ns) > _LONGEST_OVERLAP_NS:
            raise SourceError(
                f"{part}: has scans in {topic} of the same time as {before}, so they are not parts of one drive; give "
                "each as a recording of its own, NAME=PATH"
            )
