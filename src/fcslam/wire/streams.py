"""Lossless streams of ranges, keypoints and descriptors, by entropy coding.

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
    code_learnt,
    code_number,
    code_signed,
    fresh_model,
    is_at_end,
    reader,
    writer,
    written,
)
from fcslam.wire.limits import BYTES_PER_AXIS, BYTES_PER_RANGE
from fcslam.wire.prediction import PROBABILITIES, code_descriptors, sums_of

RangeCodes = NDArray[np.uint16]
KeypointCodes = NDArray[np.int16]

_APART: Final = 2
"""Keypoints this many steps apart along x, or more, share one set of contexts for y and z."""
_MOST_AXES: Final = 3
_REFUSED: Final = -1


def pack_ranges(codes: RangeCodes) -> bytes:
    """Encode ranges (N,) in steps of 2 mm, 0 for no return."""
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
        raise PacketError("keyscan: a range is no 16-bit number")
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
        raise PacketError("place: a keypoint is no 16-bit number of steps")
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
        raise PacketError(f"{what}: the stream is cut off or goes on after its end")


@njit(nogil=True)
def _code_ranges(coder: Coder, data: Bytes, codes: NDArray[np.int64]) -> Coder:
    """Code whether each range is a return, in the context of the beam before, and its difference from the last one."""
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
def _common_divisor(values: NDArray[np.int64]) -> int:
    """Greatest common divisor of all differences; 0 if there are none."""
    divisor = np.int64(0)
    for k in range(1, len(values)):
        a, b = divisor, abs(values[k] - values[k - 1])
        while b:
            a, b = b, a % b
        divisor = a
    return int(divisor)
