"""The records of an MCAP file by their headers, so that nothing is decompressed."""

import os
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO, NamedTuple

MCAP_MAGIC = b"\x89MCAP0\r\n"
HEADER, CHUNK, DATA_END = 0x01, 0x06, 0x0F
_FOOTER = 0x02
_HEADER_BYTES = 9
"""Opcode and length of a record."""
_SIZE_AT = 16
"""Where a chunk has its size without compression, after two stamps."""


class McapRecord(NamedTuple):
    """A record and where it lies in the file, in bytes."""

    opcode: int
    start: int
    """Of its content."""
    end: int


def mcap_records(file: BinaryIO) -> Iterator[McapRecord]:
    """The whole records in their order; ends where the file is truncated. The file may be read in between."""
    size, at = file.seek(0, os.SEEK_END), len(MCAP_MAGIC)
    while at + _HEADER_BYTES <= size:
        file.seek(at)
        header = file.read(_HEADER_BYTES)
        start = at + _HEADER_BYTES
        at = start + int.from_bytes(header[1:], "little")
        if at > size:
            return
        yield McapRecord(header[0], start, at)


def profile_of(file: BinaryIO) -> str | None:
    """The profile that the file names, as in ``ros2``; None without a whole header."""
    header = next(mcap_records(file), None)
    if header is None or header.opcode != HEADER:
        return None
    file.seek(header.start)
    content = file.read(header.end - header.start)
    return content[4 : 4 + int.from_bytes(content[:4], "little")].decode(errors="replace")


def chunk_bytes(file: BinaryIO) -> Iterator[int]:
    """The size of each chunk without compression, as the file states it."""
    for record in mcap_records(file):
        if record.opcode == CHUNK:
            file.seek(record.start + _SIZE_AT)
            yield int.from_bytes(file.read(8), "little")


def end_mcap(path: Path) -> bool:
    """Cut a file that was not closed after its last whole record and end it, without an index.

    Returns:
        Whether it holds messages; all are in chunks.

    Raises:
        OSError: the file cannot be written.
    """
    end, has_messages = len(MCAP_MAGIC), False
    with path.open("r+b") as file:
        for record in mcap_records(file):
            if record.opcode == DATA_END:
                break
            end, has_messages = record.end, has_messages or record.opcode == CHUNK
        file.seek(end)
        file.truncate()
        file.write(_record(DATA_END, bytes(4)) + _record(_FOOTER, bytes(20)) + MCAP_MAGIC)
    return has_messages


def _record(opcode: int, content: bytes) -> bytes:
    return bytes([opcode]) + len(content).to_bytes(8, "little") + content
