"""Lossless streams of ranges, keypoints, descriptors, words and map cells, by entropy coding.

A stream is coded if that is shorter than the plain bytes. The receiver tells the two apart by the length, because it
knows how many numbers to expect. No stream can hold more numbers.
"""

from collections.abc import Callable
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from fcslam.compiled import njit
from fcslam.errors import PacketError
from fcslam.records import CODE_BYTES, Channel, Codes
from fcslam.wire.entropy import (
    CONTEXTS_OF_NUMBER,
    Bytes,
    Coder,
    code_bit,
    code_learnt,
    code_number,
    code_signed,
    fresh_model,
    is_at_end,
    reader,
    writer,
    written,
)
from fcslam.wire.limits import BYTES_PER_AXIS, BYTES_PER_RANGE, BYTES_PER_TILE, BYTES_PER_WORD, TILE_CELLS
from fcslam.wire.prediction import PROBABILITIES, code_descriptors, sums_of

RangeCodes = NDArray[np.uint16]
KeypointCodes = NDArray[np.int16]
Words = NDArray[np.uint16]

_APART: Final = 2
"""Keypoints this many steps apart along x, or more, share one set of contexts for y and z."""
_MOST_AXES: Final = 3
_REFUSED: Final = -1
_LEARNT_BITS: Final = 4
"""The first bits of a word are learnt: numbers of similar words begin with the same bits. A place has too few words for
more.
"""
_STATES: Final = 3
"""Number of states of a cell: unknown, free, occupied."""
_NEIGHBOURS: Final = _STATES**5
"""States of the five cells before a cell that are nearest to it."""


def pack_ranges(codes: RangeCodes) -> bytes:
    """Encode ranges (N,) in steps of 2 mm, 0 for an invalid one."""
    return _pack(codes.astype("<u2").tobytes(), _code_ranges, codes.astype(np.int64))


def unpack_ranges(data: bytes, count: int) -> RangeCodes:
    """Inverse of ``pack_ranges``: ``count`` ranges in steps of 2 mm, shape (count,).

    Raises:
        PacketError: ``data`` is not a stream of ``count`` ranges.
    """
    if len(data) == BYTES_PER_RANGE * count:
        return np.frombuffer(data, "<u2").astype(np.uint16)
    codes = np.zeros(count, np.int64)
    _unpack(data, BYTES_PER_RANGE * count, "keyscan: ranges", _code_ranges, codes)
    if codes.min(initial=0) < 0 or codes.max(initial=0) > np.iinfo(np.uint16).max:
        raise PacketError("keyscan: a range is not a 16-bit number")
    return codes.astype(np.uint16)


def pack_keypoints(codes: KeypointCodes) -> bytes:
    """Encode keypoints (N, axes) in steps of 1 cm, rows in ascending order."""
    return _pack(codes.astype("<i2").tobytes(), _code_keypoints, codes.astype(np.int64))


def unpack_keypoints(data: bytes, count: int, axes: int) -> KeypointCodes:
    """Inverse of ``pack_keypoints``: ``count`` keypoints in steps of 1 cm, shape (count, axes).

    Raises:
        PacketError: ``data`` is not a stream of ``count`` keypoints.
    """
    if len(data) == BYTES_PER_AXIS * count * axes:
        codes = np.frombuffer(data, "<i2").reshape(count, axes).astype(np.int64)
    else:
        codes = np.zeros((count, axes), np.int64)
        _unpack(data, BYTES_PER_AXIS * count * axes, "place: keypoints", _code_keypoints, codes)
    if np.abs(codes).max(initial=0) > np.iinfo(np.int16).max:
        raise PacketError("place: a keypoint is not a 16-bit number of steps")
    if not np.array_equal(ascending(codes), np.arange(count)):
        raise PacketError("place: keypoints are not in ascending order")
    keypoints: KeypointCodes = codes.astype(np.int16)
    if len(data) < BYTES_PER_AXIS * codes.size and pack_keypoints(keypoints) != data:
        raise PacketError("place: keypoints are not in steps of their grid")
    return keypoints


def ascending(keypoints: NDArray[Any]) -> NDArray[np.int64]:
    """Order of keypoints (N, axes) on the wire, shape (N,): by x, then y, then z; equal ones keep their order."""
    return np.lexsort(keypoints.T[::-1])


def pack_descriptors(descriptors: Codes, keypoints: KeypointCodes, channel: Channel) -> bytes:
    """Encode descriptors (N, 32) of keypoints (N, axes) in ascending order."""
    bits = np.unpackbits(descriptors, axis=1)
    return _pack(descriptors.tobytes(), code_descriptors, bits, *_expectation(keypoints, channel))


def unpack_descriptors(data: bytes, keypoints: KeypointCodes, channel: Channel) -> Codes:
    """Inverse of ``pack_descriptors``: one descriptor for each of the keypoints (N, axes), shape (N, 32).

    Raises:
        PacketError: ``data`` is not a stream of N descriptors.
    """
    count = len(keypoints)
    if len(data) == CODE_BYTES * count:
        return np.frombuffer(data, np.uint8).reshape(count, CODE_BYTES)
    bits = np.zeros((count, 8 * CODE_BYTES), np.uint8)
    expectation = _expectation(keypoints, channel)
    _unpack(data, CODE_BYTES * count, "place: descriptors", code_descriptors, bits, *expectation)
    return np.packbits(bits, axis=1)


def pack_words(words: Words) -> bytes:
    """Encode words (N,)."""
    return _pack(words.astype("<u2").tobytes(), _code_words, words.astype(np.int64))


def unpack_words(data: bytes, count: int) -> Words:
    """Inverse of ``pack_words``: ``count`` words, shape (count,).

    Raises:
        PacketError: ``data`` is not a stream of ``count`` words.
    """
    if len(data) == BYTES_PER_WORD * count:
        return np.frombuffer(data, "<u2").astype(np.uint16)
    codes = np.zeros(count, np.int64)
    _unpack(data, BYTES_PER_WORD * count, "place: words", _code_words, codes)
    if codes.max(initial=0) > np.iinfo(np.uint16).max:
        raise PacketError("place: a word is not a 16-bit number")
    words: Words = codes.astype(np.uint16)
    if pack_words(words) != data:
        raise PacketError("place: words have more bits than the largest")
    return words


def pack_cells(cells: NDArray[np.uint8]) -> bytes:
    """Encode the cells of a map tile (256, 256): 0 unknown, 1 free, 2 occupied."""
    fours = cells.reshape(-1, 4)
    plain = (fours << np.arange(0, 8, 2, dtype=np.uint8)).sum(axis=1, dtype=np.uint8).tobytes()
    return _pack(plain, _code_cells, cells.astype(np.int64))


def unpack_cells(data: bytes) -> NDArray[np.uint8]:
    """Inverse of ``pack_cells``: shape (256, 256).

    Raises:
        PacketError: ``data`` is not a stream of a tile's cells.
    """
    if len(data) == BYTES_PER_TILE:
        fours = np.frombuffer(data, np.uint8)[:, None] >> np.arange(0, 8, 2, dtype=np.uint8)
        return (fours & np.uint8(3)).astype(np.uint8).reshape(TILE_CELLS, TILE_CELLS)
    cells = np.zeros((TILE_CELLS, TILE_CELLS), np.int64)
    _unpack(data, BYTES_PER_TILE, "map tile: cells", _code_cells, cells)
    return cells.astype(np.uint8)


def _expectation(keypoints: KeypointCodes, channel: Channel) -> tuple[NDArray[Any], ...]:
    return (keypoints.astype(np.int64), *sums_of(channel), PROBABILITIES)


def _pack(plain: bytes, code: Callable[..., Coder], *content: NDArray[Any]) -> bytes:
    data = np.zeros(len(plain), np.uint8)
    size = written(code(writer(), data, *content), data)
    return data[:size].tobytes() if 0 <= size < len(plain) else plain


def _unpack(data: bytes, plain: int, what: str, code: Callable[..., Coder], *content: NDArray[Any]) -> None:
    """Decode ``data`` into the first array of ``content``."""
    if len(data) > plain:
        raise PacketError(f"{what}: {len(data)} bytes, at most {plain}")
    stream = np.frombuffer(bytearray(data), np.uint8)
    if not is_at_end(code(reader(stream), stream, *content), stream):
        raise PacketError(f"{what}: the stream ends early or has bytes after its end")


@njit(nogil=True)
def _code_ranges(coder: Coder, data: Bytes, codes: NDArray[np.int64]) -> Coder:
    """Code whether each range is valid, in the context of the beam before, and its difference from the last one."""
    model = fresh_model(2 + CONTEXTS_OF_NUMBER)
    last, none = np.int64(0), 0
    for k in range(len(codes)):
        coder, none = code_learnt(coder, data, model, none, int(codes[k] == 0))
        if none:
            codes[k] = 0
        else:
            coder, difference = code_signed(coder, data, model, 2, codes[k] - last)
            last += difference
            codes[k] = last if last > 0 else _REFUSED
    return coder


@njit(nogil=True)
def _code_keypoints(coder: Coder, data: Bytes, codes: NDArray[np.int64]) -> Coder:
    """Code the grid of each axis, then the differences of consecutive keypoints in steps of the grid."""
    axes = codes.shape[1]
    model = fresh_model((2 + _MOST_AXES * (1 + _APART)) * CONTEXTS_OF_NUMBER)
    grid = np.ones(axes, np.int64)
    for axis in range(axes if len(codes) > 0 else 0):
        coder, beyond = code_number(coder, data, model, 0, max(_common_divisor(codes[:, axis]), 1) - 1)
        grid[axis] += beyond
        coder, codes[0, axis] = code_signed(coder, data, model, CONTEXTS_OF_NUMBER, codes[0, axis])
    for k in range(1, len(codes)):
        context = 2 * CONTEXTS_OF_NUMBER
        coder, ahead = code_number(coder, data, model, context, (codes[k, 0] - codes[k - 1, 0]) // grid[0])
        codes[k, 0] = codes[k - 1, 0] + ahead * grid[0]
        context += min(ahead, _APART) * CONTEXTS_OF_NUMBER
        for axis in range(1, axes):
            context += (1 + _APART) * CONTEXTS_OF_NUMBER
            step = (codes[k, axis] - codes[k - 1, axis]) // grid[axis]
            coder, step = code_signed(coder, data, model, context, step)
            codes[k, axis] = codes[k - 1, axis] + step * grid[axis]
    return coder


@njit(nogil=True)
def _code_words(coder: Coder, data: Bytes, words: NDArray[np.int64]) -> Coder:
    """Code the number of bits of the largest word, then every word with as many, from the highest."""
    model = fresh_model(CONTEXTS_OF_NUMBER + (1 << _LEARNT_BITS))
    bits, largest = 0, np.int64(0)
    for word in words:
        largest = max(largest, word)
    while largest >> bits:
        bits += 1
    if len(words) > 0:
        coder, bits = code_number(coder, data, model, 0, bits)
    for k in range(len(words)):
        word = np.int64(1)
        for digit in range(bits - 1, -1, -1):
            bit = int(words[k] >> digit & 1)
            if bits - digit <= _LEARNT_BITS:
                coder, bit = code_learnt(coder, data, model, CONTEXTS_OF_NUMBER + word, bit)
            else:
                coder, bit = code_bit(coder, data, 32768, bit)
            word = word << 1 | bit
        words[k] = word - (np.int64(1) << bits)
    return coder


@njit(nogil=True)
def _code_cells(coder: Coder, data: Bytes, cells: NDArray[np.int64]) -> Coder:
    """Code each cell, row by row, in the context of two cells to the left and three in the row before."""
    model = fresh_model(2 * _NEIGHBOURS)
    height, width = cells.shape
    for row in range(height):
        for column in range(width):
            context = 0
            for up, left in ((0, 1), (0, 2), (1, 1), (1, 0), (1, -1)):
                context *= _STATES
                if row >= up and 0 <= column - left < width:
                    context += cells[row - up, column - left]
            cell = cells[row, column]
            coder, known = code_learnt(coder, data, model, 2 * context, int(cell > 0))
            occupied = 0
            if known:
                coder, occupied = code_learnt(coder, data, model, 2 * context + 1, int(cell > 1))
            cells[row, column] = known + occupied
    return coder


@njit(nogil=True)
def _common_divisor(values: NDArray[np.int64]) -> int:
    """Greatest common divisor of all differences; 0 if all values are the same."""
    divisor = np.int64(0)
    for k in range(1, len(values)):
        a, b = divisor, abs(values[k] - values[k - 1])
        while b:
            a, b = b, a % b
        divisor = a
    return int(divisor)
