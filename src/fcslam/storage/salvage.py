"""Rows of a damaged SQLite file. A row counts if its seal is right, wherever in the file it is found.

This module reads each leaf page of a table by itself, from the file and from its write-ahead log. It needs neither the
header nor the schema nor the inner pages of the trees. The format: https://www.sqlite.org/fileformat2.html
"""

import struct
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

from fcslam.storage.seals import PAGE_BYTES, SEAL_BYTES, Value, contents, is_sealed, repaired_row

_OTHERS = (0x00, 0x02, 0x05, 0x0A)
"""First bytes of pages that are no leaf of a table. A damaged first byte is most probably another one."""
_FIRST_HEADER = 100
"""Bytes of the first page before its tree."""
LOG_HEADER, FRAME_HEADER = 32, 24
"""Bytes of the header of a write-ahead log, and of each of its frames."""
_LEAST_LOCAL, _MOST_LOCAL = (PAGE_BYTES - 12) * 32 // 255 - 23, PAGE_BYTES - 35
_INTEGERS = {1: 1, 2: 2, 3: 3, 4: 4, 5: 6, 6: 8}
_MOST_PAYLOAD = 2**24
"""Bytes of a row; no packet has so many."""

Row = tuple[Any, ...]
"""Values, of the types of their columns."""
ReadPage = Callable[[int], bytes]
"""Gives the page of a number, from 1; none is empty."""


class Table(NamedTuple):
    """How to read the rows of a table; its last column is the seal."""

    name: str
    types: tuple[str, ...]
    """Of its columns: INTEGER, REAL, TEXT or BLOB; "" for an INTEGER PRIMARY KEY, which is no part of the record."""
    columns: tuple[str, ...]


def salvage(path: Path, tables: tuple[Table, ...]) -> dict[str, list[Row]]:
    """All rows with a right seal, without it, by the table's name.

    A row may be found more than once, also as it was before it was changed. One damaged byte of a row's texts and blobs
    is repaired.

    Raises:
        OSError: the file cannot be read.
    """
    log = path.with_name(f"{path.name}-wal")
    frames = list(_frames(log.read_bytes())) if log.exists() else []
    newest = dict(frames)
    found: dict[str, dict[Row, None]] = {table.name: {} for table in tables}
    with contents(path) as content:

        def of_file(number: int) -> bytes:
            return content[(number - 1) * PAGE_BYTES : number * PAGE_BYTES] if number > 0 else b""

        def of_log(number: int) -> bytes:
            return newest.get(number) or of_file(number)

        pages = [(number, of_file(number), of_file) for number in range(1, len(content) // PAGE_BYTES + 1)]
        pages += [(number, page, of_log) for number, page in frames]
        for number, page, other in pages:
            for rowid, payload in _cells(page, _FIRST_HEADER if number == 1 else 0, other):
                sealed = _sealed_row(rowid, payload, tables)
                if sealed is not None:
                    found[sealed[0]][sealed[1]] = None
    return {name: list(rows) for name, rows in found.items()}


def _frames(log: bytes) -> Iterator[tuple[int, bytes]]:
    """Numbers and contents of the pages in a write-ahead log, right or not."""
    for start in range(LOG_HEADER, len(log) - FRAME_HEADER - PAGE_BYTES + 1, FRAME_HEADER + PAGE_BYTES):
        (number,) = struct.unpack_from(">I", log, start)
        yield number, log[start + FRAME_HEADER : start + FRAME_HEADER + PAGE_BYTES]


def _cells(page: bytes, header: int, other: ReadPage) -> Iterator[tuple[int, bytes]]:
    """Row ids and payloads of a leaf page of a table; ``header`` is where its header begins."""
    if page[header] in _OTHERS:
        return
    count, begin = struct.unpack_from(">HH", page, header + 3)
    # If one of both is damaged, the other one finds all cells.
    end = min(max(header + 8 + 2 * count, begin), PAGE_BYTES - 1)
    for at in range(header + 8, end, 2):
        cell = int.from_bytes(page[at : at + 2], "big")
        with suppress(ValueError, IndexError, struct.error):
            if cell > at:
                yield _cell(page, cell, other)


def _cell(page: bytes, at: int, other: ReadPage) -> tuple[int, bytes]:
    """Row id and payload of a cell, whose end may be in overflow pages."""
    size, at = _varint(page, at)
    rowid, at = _varint(page, at)
    if not 0 < size <= _MOST_PAYLOAD:
        raise ValueError
    local = size
    if size > _MOST_LOCAL:
        local = _LEAST_LOCAL + (size - _LEAST_LOCAL) % (PAGE_BYTES - 4)
        local = local if local <= _MOST_LOCAL else _LEAST_LOCAL
    payload = bytearray(page[at : at + local])
    at += local
    while len(payload) < size:
        (following,) = struct.unpack_from(">I", page, at)
        page, at = other(following), 0
        payload += page[4 : 4 + size - len(payload)]
    return rowid, bytes(payload)


def _sealed_row(rowid: int, payload: bytes, tables: tuple[Table, ...]) -> tuple[str, Row] | None:
    """The table's name and the row, if its seal is right; None otherwise."""
    with suppress(ValueError, IndexError, struct.error):
        values = _values(payload)
        for table in tables:
            if len(values) != len(table.types):
                continue
            *row, row_seal = (_of_type(value, kind, rowid) for value, kind in zip(values, table.types, strict=True))
            if not isinstance(row_seal, bytes):
                continue
            if is_sealed(row_seal, table.name, *row):
                return table.name, tuple(row)
            repaired = repaired_row(row_seal, table.name, *row) if len(row_seal) == SEAL_BYTES else None
            if repaired is not None:
                return table.name, repaired[1:]
    return None


def _of_type(value: Value, kind: str, rowid: int) -> Value:
    if not kind:
        return rowid
    return float(value) if kind == "REAL" and isinstance(value, int) else value


def _values(payload: bytes) -> list[Value]:
    """The values of a record."""
    end, at = _varint(payload, 0)
    types: list[int] = []
    while at < end:
        kind, at = _varint(payload, at)
        types.append(kind)
    values: list[Value] = []
    for kind in types:
        value, at = _value(payload, at, kind)
        values.append(value)
    if at != len(payload):
        raise ValueError
    return values


def _value(payload: bytes, at: int, kind: int) -> tuple[Value, int]:
    if kind in _INTEGERS:
        end = at + _INTEGERS[kind]
        return int.from_bytes(payload[at:end], "big", signed=True), end
    if kind == 7:
        return struct.unpack_from(">d", payload, at)[0], at + 8
    if kind >= 12:
        end = at + (kind - 12) // 2
        return (payload[at:end].decode("utf-8", "surrogateescape") if kind % 2 else payload[at:end]), end
    return {0: None, 8: 0, 9: 1}.get(kind), at


def _varint(data: bytes, at: int) -> tuple[int, int]:
    """A variable-length integer, and where the next one begins."""
    value = 0
    for _ in range(8):
        value = value << 7 | data[at] & 0x7F
        at += 1
        if data[at - 1] < 0x80:
            return value, at
    return value << 8 | data[at], at + 1
