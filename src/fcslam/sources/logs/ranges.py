"""Parses the ranges of scans: of many scans in one go, in less than half the time of one scan after another."""

from collections.abc import Iterable, Iterator
from math import nan

import numpy as np
from numpy.typing import NDArray

from fcslam.errors import SourceError
from fcslam.records import FloatArray, Ranges, frozen
from fcslam.sources.faults import Audit, Fault
from fcslam.sources.logs.dialect import Line, ScanLine

NumberedLine = tuple[int, Line | None]
"""A line with its number, counted from 1; None if it is broken."""

_Indices = NDArray[np.int64]

_LONGEST_RANGE_M = 1e6
_BATCH_LINES, _BATCH_BYTES = 256, 1 << 18
"""Lines that are parsed together; fewer if the text of their ranges is longer."""
_MAX_LETTERS = 16
"""Most characters of a number that float64 holds exactly without its point."""
_POINT, _SPACE, _ZERO = b". 0"
_POWERS = 10 ** np.arange(_MAX_LETTERS)


def parse_ahead(lines: Iterable[NumberedLine], metres_per_unit: float) -> Iterator[NumberedLine]:
    """The same lines; scans also hold their ranges where these are plain numbers, as most are."""
    for batch in _batches(lines):
        scans = [line for _, line in batch if isinstance(line, ScanLine)]
        ranges_m = _ranges_of(scans, metres_per_unit)
        if ranges_m is None:
            yield from batch
            continue
        end = 0
        for number, line in batch:
            if isinstance(line, ScanLine):
                first, end = end, end + line.beam_count
                yield number, line._replace(ranges_m=ranges_m[first:end])
            else:
                yield number, line


def parse_ranges(scan: ScanLine, metres_per_unit: float, number: int, audit: Audit) -> Ranges:
    """Ranges in metres, shape (beam_count,), invalid ones NaN; raises ValueError if one is not a number."""
    if scan.ranges_m is not None:
        return scan.ranges_m
    values = np.array(scan.range_text.split(), dtype=np.float64) * metres_per_unit
    if not (values.min() >= 0.0 and values.max() < _LONGEST_RANGE_M):
        finite, negative = np.isfinite(values), values < 0.0
        for kind, count in (
            (Fault.NON_FINITE_RANGE, np.count_nonzero(~finite)),
            (Fault.NEGATIVE_RANGE, np.count_nonzero(negative & finite)),
        ):
            if count:
                audit.add(kind, number, int(count))
        values = np.where(finite & ~negative, np.minimum(values, _LONGEST_RANGE_M), nan)
    return frozen(values, np.float32)


def plain_numbers(text: bytes) -> FloatArray | None:
    """Numbers such as 12 or 0.35, separated by single spaces; None if one is anything else.

    Either all of them have a point or none. The values are those of ``float``: a quotient of two exact numbers is the
    nearest one.
    """
    letters = np.frombuffer(text, np.uint8)
    digits = letters - _ZERO  # wraps around, so only digits are below 10
    ends = np.append(np.flatnonzero(letters == _SPACE), len(letters))
    starts = np.concatenate(((0,), ends[:-1] + 1))
    points = np.flatnonzero(letters == _POINT)
    has_points = len(points) > 0
    if len(points) != len(ends) and has_points:
        return None
    points = points if has_points else ends
    whole, decimals = points - starts, ends - points - has_points
    if whole.min() < 1 or decimals.min() < 0 or (ends - starts).max() > _MAX_LETTERS:
        return None
    if np.count_nonzero(digits < 10) != whole.sum() + decimals.sum():
        return None
    exact = _integers(digits, points, whole) * _POWERS[decimals] + _integers(digits, ends, decimals)
    return np.asarray(exact / _POWERS[decimals])


def _integers(digits: NDArray[np.uint8], ends: _Indices, lengths: _Indices) -> _Indices:
    """The integers of ``lengths`` digits before ``ends``."""
    values = np.zeros(len(ends), np.int64)
    for k in range(lengths.max()):
        values += np.where(lengths > k, digits[ends - 1 - k], 0) * _POWERS[k]
    return values


def _ranges_of(scans: list[ScanLine], metres_per_unit: float) -> Ranges | None:
    """All ranges of these scans, metres; None if some are not plain numbers."""
    values = plain_numbers(b" ".join(scan.range_text for scan in scans)) if scans else None
    if values is None or values.max() * metres_per_unit >= _LONGEST_RANGE_M:
        return None
    return frozen(values * metres_per_unit, np.float32)


def _batches(lines: Iterable[NumberedLine]) -> Iterator[list[NumberedLine]]:
    batch: list[NumberedLine] = []
    size = 0
    try:
        for number, line in lines:
            batch.append((number, line))
            size += len(line.range_text) if isinstance(line, ScanLine) else 0
            if len(batch) == _BATCH_LINES or size >= _BATCH_BYTES:
                yield batch
                batch, size = [], 0
    except SourceError:
        yield batch  # the lines before the damage
        raise
    yield batch
