"""Reads log files, compressed or not, as lines of bytes."""

import gzip
import re
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path

from fcslam.errors import SourceError
from fcslam.untrusted import open_unpacked

MAX_LINE_BYTES = 1 << 18
"""Longer lines are split, so that a file without line ends does not fill the memory."""

_HEAD_BYTES = 1 << 16
_LOG_SUFFIX = re.compile(r"\.(gz|xz|bz2|clf|log|dat|txt|carmen|bag|mcap|db3|active)$", re.IGNORECASE)
_UNSAFE = re.compile(r"[^A-Za-z0-9_.-]+")


def robot_name(path: Path) -> str:
    """Name of a robot from its file, without log suffixes and unsafe characters: ``intel.clf.xz`` gives ``intel``."""
    stem = path.name or path.resolve().name
    while match := _LOG_SUFFIX.search(stem):
        stem = stem[: match.start()]
    return _UNSAFE.sub("_", stem).strip("._-") or "robot"


def head(path: Path) -> bytes:
    """The first 64 KiB, decompressed."""
    with translate_errors(path), open_unpacked(path) as stream:
        content = stream.read(_HEAD_BYTES)
    if not content:
        raise SourceError(f"{path}: the file is empty; give a recording with laser scans")
    return content


def numbered_lines(path: Path) -> Iterator[tuple[int, bytes]]:
    """Decompressed lines with their numbers, counted from 1."""
    with translate_errors(path), open_unpacked(path) as stream:
        yield from enumerate(iter(partial(stream.readline, MAX_LINE_BYTES), b""), start=1)


@contextmanager
def translate_errors(path: Path) -> Iterator[None]:
    """Translate errors of the system and the archive modules to SourceError with a one-line message."""
    try:
        yield
    except FileNotFoundError as error:
        raise SourceError(f"{path}: no such file; check the path of the recording") from error
    except IsADirectoryError as error:
        raise SourceError(f"{path}: is a folder; give the recording's file in it") from error
    except (EOFError, gzip.BadGzipFile) as error:
        raise SourceError(f"{path}: the archive is truncated or damaged ({error}); copy it again") from error
    except (OSError, ValueError) as error:
        raise SourceError(f"{path}: cannot be read ({error}); check the file and its permissions") from error
