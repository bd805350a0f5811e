"""Finds damage in a database before it is opened, and reads what is left of it.

Every table has its rows' seals as its last column (``storage.seals``). A database that was closed has seals of its
pages beside it as well: they show damage in every byte, also in those that mean nothing.
"""

import shutil
import sqlite3
import struct
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

from fcslam.errors import StoreError
from fcslam.storage.database import expected_shape, shape, translate_errors
from fcslam.storage.files import replacing, replacing_folder
from fcslam.storage.salvage import FRAME_HEADER, LOG_HEADER, Row, Table, salvage
from fcslam.storage.seals import PAGE_BYTES, PageSeals, contents, seal, seals_file

DAMAGED = "damaged"
"""Name of the folder beside a database in which damaged files are kept."""
_HEADERS = [b"SQLite format 3\0" + bytes((PAGE_BYTES >> 8, 0, mode, mode, 0, 64, 32, 32)) for mode in (1, 2)]
"""The constant beginnings of a database: an exported one, and one with a write-ahead log."""
_SALTS_AT = 16
"""In the header of a log."""
_RIGHT_FRAMES_AT = 16
"""In the shared memory: how many frames of the log are right (https://www.sqlite.org/walformat.html)."""


@dataclass(frozen=True, slots=True)
class Damage:
    """Damage that was found."""

    found: str
    """Description of the damage."""
    rows: dict[str, list[Row]] | None
    """Rows that can be read, without their seals, by table; None: the file holds what it held before."""
    kept: Path | None
    """Folder of the files as they were found; None until ``keep``."""


def tables_of(schema: str) -> tuple[Table, ...]:
    """The tables of a schema."""
    with closing(sqlite3.connect(":memory:")) as connection:
        for statement in schema.split(";"):
            connection.execute(statement)
        names = connection.execute("SELECT name FROM sqlite_schema WHERE type = 'table' ORDER BY rowid").fetchall()
        tables = []
        for (name,) in names:
            columns = connection.execute(f"PRAGMA table_info({name})").fetchall()
            keys = [column for column in columns if column[5]]
            is_rowid = len(keys) == 1 and keys[0][2] == "INTEGER"
            types = tuple("" if is_rowid and column[5] else column[2] for column in columns)
            tables.append(Table(name, types, tuple(column[1] for column in columns)))
    return tuple(tables)


def find_damage(path: Path, schema: str, version: int) -> Damage | None:
    """Check a database that nobody has open; None: there is no damage, or no file.

    A file in which single bytes were damaged after it was closed is mended, and the damaged one is kept beside it.

    Args:
        path: the file.
        schema, version: as of ``Database``.

    Raises:
        StoreError: the file cannot be read or written.
    """
    if not path.exists():
        return None
    with translate_errors(path), contents(path) as content:
        is_closed = not _log_of(path).exists()
        seals = PageSeals.read(seals_file(path)) if is_closed else None
        pages = seals.damaged(content) if seals is not None else []
        if seals is not None and not pages:
            return None
        if seals is not None:
            mended = [seals.repaired(page, content) for page in pages]
            if all(mended):
                return _mended(path, pages, [page for page in mended if page])
        found = fault(path, schema, version)
        if found is not None:
            return Damage(found, salvage(path, tables_of(schema)), None)
        if pages:
            return Damage(f"page {_numbers(pages)} changed outside of fcslam; all rows are right", None, keep(path))
        return None


def mend_pages(path: Path) -> Path | None:
    """Mend single damaged bytes in a database that was closed; one that was not, or does not exist, is not checked.

    Returns:
        Folder of the damaged file; None if nothing is damaged.

    Raises:
        StoreError: there is more damage than that, and nothing was changed; or the disk is full.
    """
    if not path.exists() or _log_of(path).exists():
        return None
    with translate_errors(path), contents(path) as content:
        seals = PageSeals.read(seals_file(path))
        pages = [] if seals is None else seals.damaged(content)
        if seals is None or not pages:
            return None
        mended = [seals.repaired(page, content) for page in pages]
        if not all(mended):
            raise StoreError(f"{path}: page {_numbers(pages)} is damaged")
        return _mended(path, pages, [page for page in mended if page]).kept


def fault(path: Path, schema: str, version: int) -> str | None:
    """Find the damage of a database by its header, log, trees and rows; None if there is none, or if it is of another
    version.

    Raises:
        StoreError: it cannot be read now.
    """
    with path.open("rb") as file:
        header = file.read(len(_HEADERS[0]))
    if not header:
        return "the file is empty"
    if header not in _HEADERS:
        return "the header is damaged"
    try:
        with closing(sqlite3.connect(f"{path.resolve().as_uri()}?mode=ro", uri=True)) as found:
            return _fault_in(found, path, schema, version)
    except sqlite3.DatabaseError as error:
        if "locked" in str(error) or "unable to open" in str(error):
            raise StoreError(f"{path}: cannot be read ({error})") from error
        return str(error)


def keep(path: Path) -> Path:
    """Copy a database with its log to a new folder beside it.

    Raises:
        OSError: it cannot be copied.
    """
    folder = path.parent / DAMAGED
    folder.mkdir(exist_ok=True)
    number = 1 + max((int(each.name) for each in folder.iterdir() if each.name.isdecimal()), default=0)
    with replacing_folder(folder / str(number)) as unfinished:
        for file in (path, _log_of(path), seals_file(path)):
            if file.exists():
                shutil.copyfile(file, unfinished / file.name)
    return folder / str(number)


def replace(path: Path, by: Path) -> None:
    """Put a database that was closed in the place of a damaged one.

    Raises:
        OSError: it cannot be replaced.
    """
    seals_file(path).unlink(missing_ok=True)
    _log_of(path).unlink(missing_ok=True)
    path.with_name(f"{path.name}-shm").unlink(missing_ok=True)
    by.replace(path)
    seals_file(by).replace(seals_file(path))


def _mended(path: Path, pages: Sequence[int], mended: Sequence[bytes]) -> Damage:
    kept = keep(path)
    with replacing(path) as unfinished:
        shutil.copyfile(path, unfinished)
        with unfinished.open("r+b") as file:
            for page, right in zip(pages, mended, strict=True):
                file.seek(page * PAGE_BYTES)
                file.write(right)
    return Damage(f"one byte of page {_numbers(pages)} was damaged, and is mended", None, kept)


def _fault_in(found: sqlite3.Connection, path: Path, schema: str, version: int) -> str | None:
    found.execute("PRAGMA trusted_schema=OFF")
    found.create_function("seal", -1, seal, deterministic=True)
    (its_version, parts), (right_version, right_parts) = shape(found), expected_shape(schema, version)
    if (its_version, parts) != (right_version, right_parts):
        is_other = its_version != right_version and parts != right_parts
        return None if is_other else "the schema is damaged"
    if _is_log_cut(path):
        return "transactions in the write-ahead log are damaged"
    (result,) = found.execute("PRAGMA integrity_check(1)").fetchone()
    if result != "ok":
        return " ".join(str(result).split())
    for table in tables_of(schema):
        *columns, sealed = table.columns
        values = ", ".join(columns)
        statement = f"SELECT count(*) FROM {table.name} WHERE {sealed} IS NOT seal('{table.name}', {values})"
        (count,) = found.execute(statement).fetchone()
        if count:
            return f"{count} rows of {table.name} are damaged"
    return None


def _is_log_cut(path: Path) -> bool:
    """Whether the write-ahead log has committed transactions that SQLite leaves out because a byte is wrong there.

    SQLite ends a log at the first wrong checksum, without an error. To be called while it has the file open: it notes
    in the shared memory how much of the log is right. The salts tell frames of this log from older ones.
    """
    log = _log_of(path).read_bytes() if _log_of(path).exists() else b""
    if len(log) <= LOG_HEADER:
        return False
    (right,) = struct.unpack_from("=I", path.with_name(f"{path.name}-shm").read_bytes(), _RIGHT_FRAMES_AT)
    salts = struct.unpack_from(">II", log, _SALTS_AT)
    is_right = _is_header_right(log[:LOG_HEADER])
    for start in range(
        LOG_HEADER + right * (FRAME_HEADER + PAGE_BYTES), len(log) - FRAME_HEADER, FRAME_HEADER + PAGE_BYTES
    ):
        _, size, *its_salts = struct.unpack_from(">IIII", log, start)
        is_of_this_log = any(a == b for a, b in zip(its_salts, salts, strict=True))
        if size and (is_of_this_log or not is_right):
            return True
    return False


def _is_header_right(header: bytes) -> bool:
    """Whether the checksum of a log's header is right."""
    magic, *_ = struct.unpack_from(">I", header)
    words = struct.unpack_from(">6I" if magic & 1 else "<6I", header)
    first = second = 0
    for even, odd in zip(words[::2], words[1::2], strict=True):
        first = (first + even + second) % 2**32
        second = (second + odd + first) % 2**32
    return (first, second) == struct.unpack_from(">II", header, 24)


def _log_of(path: Path) -> Path:
    return path.with_name(f"{path.name}-wal")


def _numbers(pages: Sequence[int]) -> str:
    return ", ".join(str(page + 1) for page in pages)
