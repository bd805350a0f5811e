"""Mends single damaged bits in the write-ahead log of an SQLite file whose process was killed.

SQLite ends a log at the first wrong checksum, without an error, and so loses all transactions behind it. The checksum
is linear modulo 2^32: its error shows which bit of a frame is wrong. The format: https://www.sqlite.org/walformat.html
"""

import sqlite3
import struct
from collections.abc import Iterator
from contextlib import closing
from functools import cache
from pathlib import Path

import numpy as np

from fcslam.errors import StoreError
from fcslam.storage.database import translate_errors
from fcslam.storage.files import write_file
from fcslam.storage.recovery import keep
from fcslam.storage.salvage import FRAME_HEADER, LOG_HEADER
from fcslam.storage.seals import PAGE_BYTES

_FRAME = FRAME_HEADER + PAGE_BYTES
_SALTS, _SUM = slice(8, 16), slice(16, 24)
"""In the header of a frame."""
_HEADER_SALTS, _HEADER_SUM = slice(16, 24), slice(24, 32)
"""In the header of the log."""

Sum = np.ndarray
"""A checksum: two numbers modulo 2^32, shape (2,)."""


def mend_log(path: Path) -> Path | None:
    """Mend a single damaged bit of each frame in the log of a database; a file that another process uses is left.

    Returns:
        Folder of the files as they were found; None if nothing is damaged.

    Raises:
        StoreError: there is more damage than that in front of right transactions, and nothing was changed; or the disk
            is full.
    """
    log = path.with_name(f"{path.name}-wal")
    if not log.exists() or _is_in_use(path):
        return None
    with translate_errors(path):
        found, content = log.read_bytes(), path.read_bytes()
        mended = _mended(found, content)
        if mended is None:
            raise StoreError(f"{path}: transactions in its write-ahead log are damaged")
        if mended == found:
            return None
        kept = keep(path)
        write_file(log, mended)
        return kept


def _is_in_use(path: Path) -> bool:
    try:
        with closing(sqlite3.connect(f"{path.resolve().as_uri()}?mode=ro", uri=True, timeout=0.0)) as found:
            found.execute("SELECT count(*) FROM sqlite_schema").fetchone()
    except sqlite3.DatabaseError as error:
        return "locked" in str(error)
    return False


def _mended(found: bytes, content: bytes) -> bytes | None:
    """The log as it was; None if more is damaged than one bit of its header or of a frame.

    Args:
        found: the log.
        content: the file of the database.
    """
    if len(found) < LOG_HEADER + _FRAME:
        return found
    header = next((tried for tried in _with_flips(found[:LOG_HEADER]) if _is_header(tried)), None)
    if header is None:
        return None
    order, salts = _order(header), header[_HEADER_SALTS]
    starts = range(LOG_HEADER, len(found) - _FRAME + 1, _FRAME)
    frames = [found[start : start + _FRAME] for start in starts]
    # Frames behind these are of an older log.
    count = next((k for k, frame in enumerate(frames) if _bits_between(frame[_SALTS], salts) > 1), len(frames))
    before = _numbers(header[_HEADER_SUM], ">")
    for k in range(count):
        following = frames[k + 1] if k + 1 < count else None
        candidates = list(_candidates(frames[k], before, salts, order))
        if len(candidates) > 1:
            candidates = _likeliest_first(candidates, frames, k, content)
        right = next((tried for tried in candidates if _leads(tried, following, order)), None)
        if right is None and candidates:  # the next frame has more damage, or was being written
            right = candidates[0]
        if right is None:
            # The last one may be one that was being written.
            if k + 1 < count:
                return None
            break
        frames[k], before = right, _numbers(right[_SUM], ">")
    return header + b"".join(frames) + found[starts[-1] + _FRAME :]


def _candidates(frame: bytes, before: Sum, salts: bytes, order: str) -> Iterator[bytes]:
    """Possible contents of a frame: it is right, or one bit of it is wrong."""
    body, stored = frame[:8] + frame[FRAME_HEADER:], _numbers(frame[_SUM], ">")
    words, computed = _numbers(body, order), _checksum(body, before, order)
    if (computed == stored).all():
        yield frame[:8] + salts + frame[16:]
        return
    by = (_DELTAS[None, :, None] * _WEIGHTS[:, None, :] == stored - computed).all(axis=2)
    for word, k in zip(*np.nonzero(by), strict=True):
        changed = words.copy()
        changed[word : word + 1] += _DELTAS[k]
        if int(changed[word] ^ words[word]).bit_count() == 1:
            plain = changed.astype(f"{order}u4").tobytes()
            yield plain[:8] + frame[8:FRAME_HEADER] + plain[8:]
    right = computed.astype(">u4").tobytes()
    if _bits_between(right, frame[_SUM]) == 1:
        yield frame[:16] + right + frame[FRAME_HEADER:]


def _likeliest_first(candidates: list[bytes], frames: list[bytes], k: int, content: bytes) -> list[bytes]:
    """Several bits explain an error in the high bits of a sum: those that make frame ``k`` differ less from the other
    versions of its page are likelier.
    """

    def nearest(number: int, side: range) -> bytes:
        return next((frames[j][FRAME_HEADER:] for j in side if _page_number(frames[j]) == number), b"")

    @cache
    def versions(number: int) -> list[np.ndarray]:
        before, after = nearest(number, range(k - 1, -1, -1)), nearest(number, range(k + 1, len(frames)))
        of_file = content[max(number - 1, 0) * PAGE_BYTES : number * PAGE_BYTES]
        return [np.frombuffer(page, np.uint8) for page in (before, after, of_file) if len(page) == PAGE_BYTES]

    def difference(tried: bytes) -> int:
        page = np.frombuffer(tried, np.uint8, offset=FRAME_HEADER)
        return min((int((page != other).sum()) for other in versions(_page_number(tried))), default=PAGE_BYTES)

    return sorted(candidates, key=difference)


def _page_number(frame: bytes) -> int:
    return int.from_bytes(frame[:4], "big")


def _leads(frame: bytes, following: bytes | None, order: str) -> bool:
    """Whether the next frame's checksum belongs to that of this one, or is damaged itself."""
    if following is None:
        return True
    before, salts = _numbers(frame[_SUM], ">"), following[_SALTS]
    return next(_candidates(following, before, salts, order), None) is not None


def _checksum(body: bytes, before: Sum, order: str) -> Sum:
    numbers = _numbers(body, order)
    total: Sum = (_WEIGHTS * numbers[:, None]).sum(axis=0, dtype=np.uint32)
    total += (_POWER * before[None, :]).sum(axis=1, dtype=np.uint32)
    return total


def _is_header(header: bytes) -> bool:
    magic, _, page = struct.unpack_from(">III", header)
    if magic >> 1 != 0x377F0682 >> 1 or page != PAGE_BYTES:
        return False
    first = second = 0
    words = struct.unpack_from(f"{_order(header)}6I", header)
    for even, odd in zip(words[::2], words[1::2], strict=True):
        first = (first + even + second) % 2**32
        second = (second + odd + first) % 2**32
    return (first, second) == struct.unpack_from(">II", header, 24)


def _order(header: bytes) -> str:
    """Byte order of the numbers that are summed."""
    return ">" if header[3] & 1 else "<"


def _with_flips(data: bytes) -> Iterator[bytes]:
    """``data``, and all that differ from it by one bit."""
    yield data
    number = int.from_bytes(data, "big")
    for bit in range(8 * len(data)):
        yield (number ^ 1 << bit).to_bytes(len(data), "big")


def _bits_between(a: bytes, b: bytes) -> int:
    return (int.from_bytes(a, "big") ^ int.from_bytes(b, "big")).bit_count()


def _numbers(data: bytes, order: str) -> np.ndarray:
    return np.frombuffer(data, f"{order}u4").astype(np.uint32)


def _weights() -> tuple[np.ndarray, np.ndarray]:
    """By how much each number of a frame counts in its checksum, (1026, 2), and the checksum before it, (2, 2)."""
    step = np.array(((1, 1), (1, 2)), np.uint32)  # of the checksum, with each pair of numbers
    power, pairs = np.eye(2, dtype=np.uint32), []
    for _ in range((8 + PAGE_BYTES) // 8):
        # The first number of a pair counts in both sums, the second one in the second sum.
        pairs.append(((power[:, 0] + power[:, 1]), power[:, 1].copy()))
        power = power @ step
    return np.array([weight for pair in reversed(pairs) for weight in pair], np.uint32), power


_WEIGHTS, _POWER = _weights()
_DELTAS = np.concatenate(
    [np.uint32(1) << np.arange(32, dtype=np.uint32), -(np.uint32(1) << np.arange(31, dtype=np.uint32))]
)
"""By how much a number differs whose bit is wrong."""
