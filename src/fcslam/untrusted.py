"""The one reader of files that may come from somebody else: recordings, runs, missions, maps, settings, networks.

It opens regular files only, follows no link in a folder from outside, and limits what a file expands to. Errors are
``OSError`` and ``ValueError``, which callers report with the file's name. ``tests/test_untrusted.py`` finds readers
that bypass this module.
"""

import bz2
import gzip
import io
import lzma
import os
import sqlite3
import stat
import struct
import warnings
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any, BinaryIO, Final, cast

import numpy as np
from numpy.typing import NDArray

MOST_BYTES: Final = 1 << 31
"""Largest file that is read as a whole."""
MOST_TEXT_BYTES: Final = 1 << 18
"""Largest file of settings, or description of a map."""
FREE_BYTES: Final = 1 << 25
"""Compressed content may always expand to this size."""
MOST_RATIO: Final = 32
"""Above it, content that is kept in memory may expand by this factor."""
MOST_IMAGE_RATIO: Final = 64
"""The same for the pixels of an image; a map of unknown cells compresses well."""
MOST_STREAM_RATIO: Final = 100
"""The same for content that is read piece by piece. Logs of lasers that see little compress well."""
MOST_LINES: Final = 5_000_000
"""Lines of a compressed text, beside one for each of its bytes; a line of a log has tens of bytes."""
MOST_CHUNKS_RATIO: Final = 200
"""The same for all chunks of a bag together; each is small. Scans of a simulated robot that stands compress well."""
_MOST_FRAMES: Final = 100
"""Compressed frames in one content."""
STEPS: Final = 100_000
"""Steps of SQLite between two looks at their number."""
_FREE_STEPS: Final = 20_000_000
_STEPS_PER_BYTE: Final = 20
"""Steps that SQLite may take to read a database; an honest one needs less than one per byte."""
_BUFFER_BYTES: Final = 1 << 17
_COMPRESSED: Final = (".gz", ".xz", ".bz2")
_PNG: Final = b"\x89PNG\r\n\x1a\n"
_IMAGES: Final = ("JPEG", "PPM", "TIFF", "BMP", "WEBP")
_BYTES_OF_BAND: Final = {"I": 4, "F": 4, "I;16": 2, "I;16B": 2}
"""Bytes of a pixel by Pillow's mode; the other modes have one for each band."""
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
        OSError: the file is missing, unreadable, a link within the folder, or a folder, pipe or device.
        LimitError: it is larger than ``most``.
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


def check_file(path: Path, within: Path) -> None:
    """Refuse what ``open_file`` does not open.

    Raises:
        OSError: as ``open_file``.
    """
    open_file(path, within).close()


def read_bytes(path: Path, within: Path | None = None, most: int = MOST_BYTES) -> bytes:
    """The content of a file.

    Raises:
        OSError: as ``open_file``, or the file is larger than ``most``.
    """
    with open_file(path, within, most) as file:
        return file.read(os.fstat(file.fileno()).st_size)


def read_text(path: Path, within: Path | None = None, most: int = MOST_BYTES) -> str:
    """The content of a file of UTF-8 text, its line ends as they are.

    Raises:
        OSError: as ``read_bytes``.
        ValueError: it is not UTF-8.
    """
    return read_bytes(path, within, most).decode("utf-8")


def read_arrays(path: Path) -> Arrays:
    """Every array of a ``.npz`` file; objects are not read.

    Raises:
        OSError: as ``open_file``, or the arrays are larger than ``most_unpacked`` of the file's size.
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
        except (
            zipfile.BadZipFile,
            EOFError,
            KeyError,
            AttributeError,
            RuntimeError,
            TypeError,
            zlib.error,
            lzma.LZMAError,
            MemoryError,
        ) as error:
            raise ValueError(f"no archive of arrays: {error}") from error


def open_unpacked(path: Path, by_name: bool = False) -> BinaryIO:
    """Open a file that may be compressed by gzip, xz or bzip2, as its first bytes say, to read what it holds.

    Args:
        path: of the file.
        by_name: whether a file named as a compressed one must be compressed.

    Raises:
        OSError: as ``open_file``, or the name says otherwise. Reading raises ``LimitError`` if the file expands beyond
            the limit.
    """
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
    elif by_name and path.suffix in _COMPRESSED:
        file.close()
        raise OSError(f"not a {path.suffix} file")
    else:
        return file
    return cast("BinaryIO", io.BufferedReader(_Limited(unpacking, file, size), _BUFFER_BYTES))


def open_zstd(file: BinaryIO) -> BinaryIO:
    """Read what an opened file holds that is compressed by zstd; reading has the limits of ``open_unpacked``."""
    from backports import zstd

    limited = _Limited(zstd.open(file, "rb"), file, os.fstat(file.fileno()).st_size, is_text=False)
    return cast("BinaryIO", io.BufferedReader(limited, _BUFFER_BYTES))


class _Limited(io.RawIOBase):
    """Bytes of an unpacking stream, up to the limits for a compressed file of ``size`` bytes."""

    def __init__(self, stream: Any, file: BinaryIO, size: int, *, is_text: bool = True) -> None:
        self._stream, self._file, self._size = stream, file, size
        self._unpacked, self._lines_left = 0, MOST_LINES + size if is_text else 1 << 63

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: Any) -> int:
        content = self._stream.read(len(buffer))
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
    """Check what ``packed`` bytes from outside expand to.

    Raises:
        LimitError: to more than ``most_unpacked``.
    """
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
    try:
        content, is_whole = _unpacked(packed, _DECOMPRESSORS[compression], limit)
    except Exception as error:  # four libraries, each with errors of its own
        raise ValueError(f"damaged {compression} data ({error})") from error
    check_unpacked(len(packed), len(content))
    if most is None and not is_whole:
        raise ValueError(f"{compression} data are cut off")
    return content


def check_image(encoded: bytes) -> None:
    """Check the size of an image by its header, before its pixels are decoded.

    Raises:
        LimitError: the pixels would fill the memory.
        ValueError: it is no image of a known format.
    """
    width, height, pixel_bytes = _png_size(encoded) if encoded.startswith(_PNG) else _image_size(encoded)
    most = most_unpacked(len(encoded), MOST_IMAGE_RATIO)
    if width * height * pixel_bytes > most:
        raise LimitError(
            f"the image has {width} x {height} pixels, which would fill the memory; the limit is {_size(most)}"
        )


def _png_size(encoded: bytes) -> tuple[int, int, int]:
    """Width, height and bytes of a pixel by the header, which Pillow does not read of large maps."""
    width, height, depth, kind = struct.unpack_from(">IIBB", encoded.ljust(26, b"\0"), 16)
    return width, height, 4 * (depth // 8 or 1) if kind else depth // 8 or 1


def _image_size(encoded: bytes) -> tuple[int, int, int]:
    """Width, height and bytes of a pixel by the header."""
    from PIL import Image

    try:
        with warnings.catch_warnings(), Image.open(io.BytesIO(encoded), formats=_IMAGES) as image:
            return (*image.size, _BYTES_OF_BAND.get(image.mode, len(image.getbands())))
    except Image.DecompressionBombError as error:
        raise LimitError(str(error)) from error
    except Exception as error:  # Pillow's formats raise errors of many types
        raise ValueError("the image cannot be read; copy it again, or save it as PGM or PNG") from error


def _unpacked(packed: bytes, decompressor: Callable[[], Any], limit: int) -> tuple[bytes, bool]:
    """The content up to ``limit`` bytes, and whether its last frame is whole."""
    content = b""
    for _ in range(_MOST_FRAMES):
        if len(content) == limit:  # zlib takes 0 for no limit
            return content, True
        unpacking = decompressor()
        part = unpacking.decompress(packed, limit - len(content))
        content = content + part if content else part
        packed = unpacking.unused_data
        if not unpacking.eof or not packed:
            return content, unpacking.eof
    raise ValueError(f"more than {_MOST_FRAMES} frames")


def _lz4() -> Any:
    from lz4.frame import LZ4FrameDecompressor  # type: ignore[import-untyped]

    return LZ4FrameDecompressor()


def _zstd() -> Any:
    from backports.zstd import ZstdDecompressor

    return ZstdDecompressor()


_DECOMPRESSORS: Final[dict[str, Callable[[], Any]]] = {
    "zlib": zlib.decompressobj,
    "bz2": bz2.BZ2Decompressor,
    "lz4": _lz4,
    "zstd": _zstd,
}


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
        connection.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, longest_value(size))
        connection.set_progress_handler(step_counter(size), STEPS)
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


def longest_value(size: int) -> int:
    """The longest value in a database of ``size`` bytes: a damaged one can name longer ones, which fill the memory."""
    return min(max(size, 1 << 20), 1_000_000_000)


def step_counter(size: int) -> Callable[[], bool]:
    """A progress handler for a database of ``size`` bytes, called every ``STEPS``: true when it takes too many."""
    left = (_FREE_STEPS + _STEPS_PER_BYTE * size) // STEPS

    def is_too_much() -> bool:
        nonlocal left
        left -= 1
        return left < 0

    return is_too_much


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
