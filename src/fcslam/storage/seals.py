"""Seals: checksums of rows and of a file's pages, which also show where a single byte was damaged.

A seal is a BLAKE2b hash and the XOR of the bytes. The XOR shows by how much a damaged byte differs; the byte that makes
the hash right is the damaged one.
"""

import mmap
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from hashlib import blake2b
from pathlib import Path

import numpy as np

from fcslam.storage.files import write_file

PAGE_BYTES = 4096
_HASH_BYTES = 16
SEAL_BYTES = _HASH_BYTES + 1
_SIZE_BYTES = 8

Value = int | float | str | bytes | None
"""A value of a row."""
Content = bytes | mmap.mmap
"""The bytes of a file."""


def seal(*values: Value) -> bytes:
    """Seal of a row: a hash of the table's name and all values, and the XOR of the bytes of its texts and blobs."""
    return _row_hash(values) + bytes((_row_xor(values),))


def is_sealed(row_seal: bytes, *values: Value) -> bool:
    """Whether values and seal belong together; one damaged byte of the seal itself does not count."""
    expected = seal(*values)
    return len(row_seal) == SEAL_BYTES and sum(a != b for a, b in zip(expected, row_seal, strict=True)) <= 1


def repaired_row(row_seal: bytes, *values: Value) -> tuple[Value, ...] | None:
    """The values as they were before one byte of a text or blob was damaged; None if that is not what happened."""
    by = _row_xor(values) ^ row_seal[-1]
    for index, value in enumerate(values):
        if isinstance(value, str | bytes):

            def row(tried: bytes, index: int = index, value: Value = value) -> tuple[Value, ...]:
                text = tried.decode("utf-8", "surrogateescape") if isinstance(value, str) else tried
                return (*values[:index], text, *values[index + 1 :])

            def is_right(tried: bytes, row: Callable[[bytes], tuple[Value, ...]] = row) -> bool:
                return _row_hash(row(tried)) == row_seal[:_HASH_BYTES]

            found = _repaired(_raw(value), by, is_right)
            if found is not None:
                return row(found)
    return None


class PageSeals:
    """Seals of all pages of a file that nobody writes."""

    def __init__(self, size: int, seals: bytes) -> None:
        self._size, self._seals = size, seals

    @classmethod
    def of(cls, content: Content) -> "PageSeals":
        """Seal a file's pages."""
        pages = (content[start : start + PAGE_BYTES] for start in range(0, len(content), PAGE_BYTES))
        return cls(len(content), b"".join([_hash(page) + bytes((_xor(page),)) for page in pages]))

    @classmethod
    def read(cls, path: Path) -> "PageSeals | None":
        """Read the bytes that ``write`` wrote; None if there is no file, or a damaged one.

        Raises:
            OSError: the file cannot be read.
        """
        try:
            content = path.read_bytes()
        except FileNotFoundError:
            return None
        if _hash(content[_HASH_BYTES:]) != content[:_HASH_BYTES]:
            return None
        body = content[_HASH_BYTES:]
        return cls(int.from_bytes(body[:_SIZE_BYTES], "big"), body[_SIZE_BYTES:])

    def write(self, path: Path) -> None:
        """Write the seals as a file.

        Raises:
            OSError: the file cannot be written.
        """
        body = self._size.to_bytes(_SIZE_BYTES, "big") + self._seals
        write_file(path, _hash(body) + body)

    def damaged(self, content: Content) -> list[int]:
        """Numbers of the pages, from 0, that are not as they were; those that are missing or too many as well."""
        size = max(len(content), self._size)
        return [
            start // PAGE_BYTES
            for start in range(0, size, PAGE_BYTES)
            if _hash(content[start : start + PAGE_BYTES]) != self._seal(start // PAGE_BYTES)[:_HASH_BYTES]
        ]

    def repaired(self, page: int, content: Content) -> bytes | None:
        """A page as it was before one of its bytes was damaged; None if that is not what happened."""
        if len(content) != self._size:
            return None
        damaged, page_seal = content[page * PAGE_BYTES : (page + 1) * PAGE_BYTES], self._seal(page)
        return _repaired(damaged, _xor(damaged) ^ page_seal[-1], lambda tried: _hash(tried) == page_seal[:_HASH_BYTES])

    def _seal(self, page: int) -> bytes:
        return self._seals[page * SEAL_BYTES : (page + 1) * SEAL_BYTES]


def seals_file(path: Path) -> Path:
    """Where the seals of a database's pages are; only while nobody has it open."""
    return path.with_name(f"{path.name}.seals")


def seal_pages(path: Path) -> None:
    """Seal the pages of a database that was closed; not while another process has it open.

    Raises:
        OSError: the file cannot be read, or the seals cannot be written.
    """
    if path.stat().st_size and not path.with_name(f"{path.name}-wal").exists():
        with contents(path) as content:
            PageSeals.of(content).write(seals_file(path))


@contextmanager
def contents(path: Path) -> Iterator[Content]:
    """The bytes of a file, which is not read into memory as a whole.

    Raises:
        OSError: the file cannot be read.
    """
    with path.open("rb") as file:
        if not path.stat().st_size:
            yield b""
            return
        with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as content:
            yield content


def _repaired(damaged: bytes, by: int, is_right: Callable[[bytes], bool]) -> bytes | None:
    tried = bytearray(damaged)
    for at in range(len(tried) if by else 0):
        tried[at] ^= by
        if is_right(bytes(tried)):
            return bytes(tried)
        tried[at] ^= by
    return None


def _row_hash(values: tuple[Value, ...]) -> bytes:
    # SQLite stores -0.0 as 0.0.
    plain = [value + 0.0 if isinstance(value, float) else value for value in values]
    sizes = [len(value) if isinstance(value, bytes) else value for value in plain]
    blobs = [value for value in plain if isinstance(value, bytes)]
    return blake2b(b"".join((repr(sizes).encode("utf-8", "surrogatepass"), *blobs)), digest_size=_HASH_BYTES).digest()


def _row_xor(values: tuple[Value, ...]) -> int:
    return _xor(b"".join([_raw(value) for value in values if isinstance(value, str | bytes)]))


def _raw(value: str | bytes) -> bytes:
    return value.encode("utf-8", "surrogateescape") if isinstance(value, str) else value


def _hash(content: bytes) -> bytes:
    return blake2b(content, digest_size=_HASH_BYTES).digest()


def _xor(content: bytes) -> int:
    return int(np.bitwise_xor.reduce(np.frombuffer(content, np.uint8))) if len(content) else 0
