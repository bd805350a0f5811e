"""Packed 256-bit codes: Hamming distances and mutual nearest neighbours.

A set of codes has shape (N, 32), uint8. Compiled code sees it as (N, 4) uint64 and uses the popcount instruction.
"""

from typing import Any, NamedTuple

import numpy as np
from numba import types
from numba.extending import intrinsic
from numpy.typing import NDArray

from fcslam.compiled import njit
from fcslam.records import CODE_BYTES, Codes

CODE_BITS = 8 * CODE_BYTES
CODE_WORDS = CODE_BYTES // 8
"""64-bit words of a code."""

CodeWords = NDArray[np.uint64]
"""Shape (N, 4)."""

_INDEX_BITS = 22
"""Bits of a match key that hold the index; the 10 bits above hold the distance."""
_MOST_CODES = 1 << _INDEX_BITS
_UNMATCHED = np.uint32(0xFFFFFFFF)
"""Match key of a code without a neighbour."""


LARGEST_HAMMING = 60
"""Largest Hamming distance of two matching descriptors, bits."""


class Matches(NamedTuple):
    """Matched codes of two sets."""

    pairs: NDArray[np.int64]
    """Shape (M, 2): index into the first set, index into the second; ascending in the first."""
    distances: NDArray[np.uint16]
    """Shape (M,): Hamming distance in bits."""


@intrinsic
def popcount(_context: Any, word: Any) -> Any:
    """Bits set in a uint64; for use in compiled code only."""

    def generate(_target: Any, builder: Any, _signature: Any, arguments: Any) -> Any:
        return builder.ctpop(arguments[0])

    return (types.uint64(types.uint64), generate) if word == types.uint64 else None


def code_words(codes: Codes) -> CodeWords:
    """View codes (N, 32) as read-only, aligned uint64 (N, 4); a copy if a view is impossible."""
    if codes.ndim != 2 or codes.shape[1] != CODE_BYTES or codes.dtype != np.uint8:
        raise ValueError(f"expected codes of shape (N, {CODE_BYTES}) uint8, not {codes.shape} {codes.dtype}")
    words: CodeWords = np.ascontiguousarray(codes).view(np.uint64)
    if not words.flags.aligned:
        words = words.copy()
    words.setflags(write=False)
    return words


def hamming_matrix(a: Codes, b: Codes) -> NDArray[np.uint16]:
    """Distances in bits between every code of ``a`` (N, 32) and every code of ``b`` (M, 32), shape (N, M)."""
    distances: NDArray[np.uint16] = _hamming_matrix(code_words(a), code_words(b))
    return distances


def mutual_matches(a: Codes, b: Codes, max_distance: int = CODE_BITS) -> Matches:
    """Match codes of ``a`` (N, 32) and ``b`` (M, 32) that are each other's nearest neighbour.

    Pairs are at most ``max_distance`` bits apart. Of equally near neighbours, the one with the lowest index counts.
    """
    if max(len(a), len(b)) > _MOST_CODES:
        raise ValueError(f"at most {_MOST_CODES} codes a set, not {max(len(a), len(b))}")
    return Matches(*_mutual_matches(code_words(a), code_words(b), max_distance))


@njit(allocates=False)
def hamming(a: CodeWords, b: CodeWords) -> Any:
    """Hamming distance between two codes, shape (4,) each, in bits; for use in compiled code."""
    return popcount(a[0] ^ b[0]) + popcount(a[1] ^ b[1]) + popcount(a[2] ^ b[2]) + popcount(a[3] ^ b[3])


@njit
def _hamming_matrix(a: CodeWords, b: CodeWords) -> NDArray[np.uint16]:
    distances = np.empty((a.shape[0], b.shape[0]), np.uint16)
    for i in range(a.shape[0]):
        for j in range(b.shape[0]):
            distances[i, j] = hamming(a[i], b[j])
    return distances


@njit
def _mutual_matches(a: CodeWords, b: CodeWords, max_distance: int) -> tuple[NDArray[np.int64], NDArray[np.uint16]]:
    row_keys, column_keys = _nearest_keys(a, b)
    pairs, distances = np.empty((a.shape[0], 2), np.int64), np.empty(a.shape[0], np.uint16)
    count = 0
    for row in range(a.shape[0]):
        column, distance = row_keys[row] & (_MOST_CODES - 1), row_keys[row] >> _INDEX_BITS
        if row_keys[row] == _UNMATCHED or distance > max_distance or column_keys[column] & (_MOST_CODES - 1) != row:
            continue
        pairs[count, 0], pairs[count, 1], distances[count] = row, column, distance
        count += 1
    return pairs[:count], distances[:count]


@njit
def _nearest_keys(a: CodeWords, b: CodeWords) -> tuple[NDArray[np.uint32], NDArray[np.uint32]]:
    """Nearest neighbours of ``a`` (N, 4) in ``b`` (M, 4) and back in one pass, as keys (N,) and (M,).

    A key is distance << 22 | index, so that one minimum finds the nearest and breaks ties by the index. ``b`` is
    transposed first, so that the compiler vectorises the inner loop.
    """
    columns = b.T.copy()
    row_keys = np.full(a.shape[0], _UNMATCHED, np.uint32)
    column_keys = np.full(b.shape[0], _UNMATCHED, np.uint32)
    for i in range(a.shape[0]):
        a0, a1, a2, a3 = a[i, 0], a[i, 1], a[i, 2], a[i, 3]
        best = _UNMATCHED
        for j in range(b.shape[0]):
            distance = popcount(a0 ^ columns[0, j]) + popcount(a1 ^ columns[1, j])
            distance += popcount(a2 ^ columns[2, j]) + popcount(a3 ^ columns[3, j])
            key = np.uint32(distance) << np.uint32(_INDEX_BITS)
            best = min(best, key | np.uint32(j))
            column_keys[j] = min(column_keys[j], key | np.uint32(i))
        row_keys[i] = best
    return row_keys, column_keys
