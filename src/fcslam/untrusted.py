"""The one reader of files that may come from somebody else: recordings, runs, missions, maps, settings, networks.

It opens regular files only, follows no link in a folder from outside, and limits what a file expands to. Callers report
``OSError`` and ``ValueError`` with the file's name. ``tests/test_untrusted.py`` finds readers elsewhere.
"""

import bz2
import gzip
import io
import lzma
import math
import os
import sqlite3
import stat
import struct
import sys
import warnings
import zipfile
import zlib
from collections.abc import Callable
from importlib import import_module
from itertools import repeat
from pathlib import Path
from typing import Any, BinaryIO, Final, cast

import numpy as np
from numpy.typing import NDArray

zstd = import_module("compression.zstd" if sys.version_info >= (3, 14) else "backports.zstd")
ZSTD: Final = b"\x28\xb5\x2f\xfd"
"""The first bytes of a file or message in zstd."""
MOST_BYTES: Final = 1 << 31
"""Largest file that is read as a whole."""
MOST_TEXT_BYTES: Final = 1 << 18
"""Largest file of settings, or description of a map."""
FREE_BYTES: Final = 1 << 25
"""Compressed content may always expand to this size."""
MOST_RATIO: Final = 64
"""Above it, content that is kept in memory may expand by this factor; a map of unknown cells compresses well."""
MOST_STREAM_RATIO: Final = 200
"""The same for content that is read piece by piece. Scans of a simulated robot that stands compress well."""
MOST_LINES: Final = 5_000_000
"""Lines of a compressed text, beside one for each of its bytes; a line of a log has tens of bytes."""
_MOST_FRAMES: Final = 100
"""Compressed frames in one content."""
_BUFFER_BYTES: Final = 1 << 17
_FLAGS: Final = os.O_RDONLY | os.O_NONBLOCK | os.O_NOCTTY | os.O_CLOEXEC
"""Without O_NONBLOCK, opening a pipe waits for a writer."""

Arrays = dict[str, NDArray[Any]]


class LimitError(OSError):
    """A file exceeds a limit; the message names the limit."""


def open_file(path: Path, within: Path | None = None, most: int | None = None) -> BinaryIO:
    """Open a regular file for reading.

    Args:
        path: the file; a link that the user names is followed.
        within: a folder from outside that holds the file, directly or in folders: nothing below it may be a link.
        most: the largest size, bytes; None: any.

    Raises:
        OSError: the file cannot be opened, is not regular, or is a link within the folder; too large: LimitError.
    """
    descriptor = os.open(path, _FLAGS) if within is None else _open_within(path, within)
    try:
        found = os.fstat(descriptor)
        if stat.S_ISDIR(found.st_mode):
            raise IsADirectoryError(f"{path} is a folder, not a file")
        if not stat.S_ISREG(found.st_mode):
            raise OSError(f"{path} is a pipe or device, not a file")
        if most is not None and found.st_size > most:
            raise LimitError(f"{path.name} has {_size(found.st_size)}; the limit is {_size(most)}")
        return os.fdopen(descriptor, "rb", _BUFFER_BYTES)
    except BaseException:
        os.close(descriptor)
        raise


def read_bytes(path: Path, within: Path | None = None, most: int = MOST_BYTES) -> bytes:
    """The content of a file; raises as ``open_file``."""
    with open_file(path, within, most) as file:
        return file.read(os.fstat(file.fileno()).st_size)


def read_text(path: Path, within: Path | None = None, most: int = MOST_BYTES) -> str:
    """The content of a file of UTF-8 text, its line ends as they are; what is not UTF-8 is a ValueError."""
    return read_bytes(path, within, most).decode("utf-8")


def read_arrays(path: Path) -> Arrays:
    """Every array of a ``.npz`` file; objects are not read.

    Raises:
        OSError: as ``open_file``, or the arrays expand beyond the limit.
        ValueError: the file is not an archive of arrays, or is broken.
    """
    with open_file(path) as file:
        try:
            with zipfile.ZipFile(file) as archive:
                total = sum(member.file_size for member in archive.infolist())
            check_unpacked(os.fstat(file.fileno()).st_size, total)
            file.seek(0)
            with np.load(file, allow_pickle=False) as found:
                return {name: found[name] for name in found.files}
        except OSError:
            raise
        except Exception as error:  # the archive, its compressions and NumPy have errors of their own
            raise ValueError(f"not an archive of arrays: {error}") from error


def open_unpacked(path: Path) -> BinaryIO:
    """Open a file that may be compressed by gzip, xz, bzip2 or zstd, as its first bytes say, to read what it holds."""
    file = open_file(path)
    magic = file.read(6)
    file.seek(0)
    size = os.fstat(file.fileno()).st_size
    if magic.startswith(b"\x1f\x8b"):
        unpacking: Any = gzip.GzipFile(fileobj=file)
    elif magic.startswith(b"\xfd7zXZ\x00"):
        unpacking = lzma.LZMAFile(file)  # noqa: SIM115  _Limited closes it
    elif magic.startswith(b"BZh"):
        unpacking = bz2.BZ2File(file)
    elif magic.startswith(ZSTD):
        unpacking = zstd.open(file, "rb")
    else:
        return file
    lines = math.inf if magic.startswith(ZSTD) else MOST_LINES + size  # of zstd may also be a bag, which has no lines
    return cast("BinaryIO", io.BufferedReader(_Limited(unpacking, file, size, lines), _BUFFER_BYTES))


class _Limited(io.RawIOBase):
    """Bytes of an unpacking stream, up to the limits for a compressed file of ``size`` bytes."""

    def __init__(self, stream: Any, file: BinaryIO, size: int, lines: float) -> None:
        self._stream, self._file, self._size = stream, file, size
        self._unpacked, self._lines_left = 0, lines

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: Any) -> int:
        try:
            content = self._stream.read(len(buffer))
        except OSError:
            raise
        except Exception as error:  # each library has errors of its own for a damaged or truncated archive
            raise EOFError(str(error)) from error
        self._unpacked += len(content)
        self._lines_left -= content.count(b"\n")
        check_unpacked(self._size, self._unpacked, MOST_STREAM_RATIO)
        if self._lines_left < 0:
            raise LimitError(f"{_size(self._size)} unpack to more than {MOST_LINES + self._size} lines, the limit")
        buffer[: len(content)] = content
        return len(content)

    def close(self) -> None:
        self._stream.close()
        self._file.close()
        super().close()


def most_unpacked(packed: int, ratio: int = MOST_RATIO) -> int:
    """Bytes to which ``packed`` bytes may expand."""
    return FREE_BYTES + ratio * packed


def check_unpacked(packed: int, unpacked: int, ratio: int = MOST_RATIO) -> None:
    """Raise ``LimitError`` if ``packed`` bytes from outside expand beyond the limit."""
    most = most_unpacked(packed, ratio)
    if unpacked > most:
        raise LimitError(f"{_size(packed)} unpack to more than {_size(most)}, the limit")


def unpack(packed: bytes, compression: str, most: int | None = None) -> bytes:
    """Unpack the content of a chunk, column or message.

    Args:
        packed: compressed bytes.
        compression: ``zlib``, ``bz2``, ``lz4`` or ``zstd``; empty or ``none``: the bytes are not compressed.
        most: stop at this size, and accept content that is cut off; None: all of it.

    Raises:
        LimitError: it expands to more than ``most_unpacked``.
        ValueError: the bytes are damaged, or the compression is unknown.
    """
    if compression in ("", "none"):
        return packed
    allowed = most_unpacked(len(packed))
    limit = allowed + 1 if most is None else min(most, allowed + 1)
    content, left, is_whole = b"", packed, True
    try:
        for _ in range(_MOST_FRAMES):
            if len(content) == limit:  # zlib takes 0 for no limit
                break
            unpacking = _decompressor(compression)
            part = unpacking.decompress(left, limit - len(content))
            content, left, is_whole = content + part if content else part, unpacking.unused_data, unpacking.eof
            if not is_whole or not left:
                break
        else:
            raise ValueError(f"more than {_MOST_FRAMES} frames")
    except Exception as error:  # four libraries, each with errors of its own
        raise ValueError(f"damaged {compression} data ({error})") from error
    check_unpacked(len(packed), len(content))
    if most is None and not is_whole:
        raise ValueError(f"{compression} data are cut off")
    return content


def _decompressor(compression: str) -> Any:
    if compression == "lz4":
        from lz4.frame import LZ4FrameDecompressor  # type: ignore[import-untyped]

        return LZ4FrameDecompressor()
    plain: dict[str, Callable[[], Any]] = {
        "zlib": zlib.decompressobj,
        "bz2": bz2.BZ2Decompressor,
        "zstd": zstd.ZstdDecompressor,
    }
    return plain[compression]()


def check_image(encoded: bytes) -> None:
    """Check the size of an image by its header, before its pixels are decoded; an unknown format is a ValueError."""
    width, height, pixel_bytes = image_size(encoded)
    most = most_unpacked(len(encoded))
    if width * height * pixel_bytes > most:
        raise LimitError(
            f"the image has {width} x {height} pixels, which would fill the memory; the limit is {_size(most)}"
        )


def image_size(encoded: bytes) -> tuple[int, int, int]:
    """Width, height and bytes of a pixel by the header of an image; an unknown format is a ValueError."""
    if encoded.startswith(b"\x89PNG\r\n\x1a\n"):  # Pillow does not read that of large maps
        width, height, depth, kind = struct.unpack_from(">IIBB", encoded.ljust(26, b"\0"), 16)
        return width, height, 4 * (depth // 8 or 1) if kind else depth // 8 or 1
    from PIL import Image

    try:
        with (
            warnings.catch_warnings(),
            Image.open(io.BytesIO(encoded), formats=("JPEG", "PPM", "TIFF", "BMP", "WEBP")) as image,
        ):
            return (*image.size, 4 if image.mode[0] in "IF" else len(image.getbands()))
    except Image.DecompressionBombError as error:
        raise LimitError(str(error)) from error
    except Exception as error:  # Pillow's formats raise errors of many types
        raise ValueError("the image cannot be read; copy it again, or save it as PGM or PNG") from error


def open_database(path: Path) -> sqlite3.Connection:
    """Open an SQLite database to read its tables. It is not changed, and none of its code runs.

    Raises:
        OSError: as ``open_file``.
        sqlite3.Error: it is damaged, or has a view, a trigger, a virtual table or a computed column.
    """
    with open_file(path) as file:
        size = os.fstat(file.fileno()).st_size
    connection = sqlite3.connect(f"{path.resolve().as_uri()}?mode=ro&immutable=1", uri=True)
    try:
        connection.execute("PRAGMA trusted_schema=OFF")
        # a damaged database can name values that fill the memory, and queries that never end
        connection.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, min(max(size, 1 << 20), 1_000_000_000))
        steps = repeat(False, 200 + size // 5000)  # of 100,000; an honest database needs less than one for each byte
        connection.set_progress_handler(lambda: next(steps, True), 100_000)
        found = connection.execute(
            "SELECT type, name FROM sqlite_schema WHERE type NOT IN ('table', 'index') OR rootpage = 0"
            " UNION ALL SELECT 'computed column', part.name FROM sqlite_schema AS whole, "
            "pragma_table_xinfo(whole.name) AS part WHERE whole.type = 'table' AND part.hidden LIMIT 1"
        ).fetchone()
        if found is not None:
            raise sqlite3.DatabaseError(f"it has the {found[0]} {str(found[1])[:64]!r}; only tables are read")
    except BaseException:
        connection.close()
        raise
    return connection


def _open_within(path: Path, within: Path) -> int:
    parts = path.relative_to(within).parts
    folder = os.open(within, _FLAGS | os.O_DIRECTORY)
    try:
        for number, part in enumerate(parts):
            is_last = number == len(parts) - 1
            if part == "..":
                raise OSError(f"{path} is not inside {within}")
            try:
                found = os.open(part, _FLAGS | os.O_NOFOLLOW | (0 if is_last else os.O_DIRECTORY), dir_fd=folder)
            except OSError:
                if stat.S_ISLNK(os.stat(part, dir_fd=folder, follow_symlinks=False).st_mode):
                    raise OSError(f"{'/'.join(parts)} is a link; put the file itself there") from None
                raise
            os.close(folder)
            folder = found
        return os.dup(folder)
    finally:
        os.close(folder)


def _size(count: int) -> str:
    return f"{count / 1e6:.1f} MB" if count >= 100_000 else f"{count} bytes"
