"""Ranges, keypoints and information matrices in the precision that the wire carries.

A robot works with the ranges that it sends, ``dequantise(quantise(ranges))``, so that it and the cloud see the same
numbers.
"""

import zlib
from collections.abc import Sequence

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from fcslam.errors import PacketError
from fcslam.records import FloatArray, Ranges, frozen
from fcslam.wire.limits import BYTES_PER_RANGE, MAXIMUM_BEAMS, MAXIMUM_RANGES_BYTES

RANGE_STEP_M = 0.002
"""Rounding adds a standard deviation of 0.6 mm to the 10-30 mm of a 2D LiDAR; 16 bits then reach 131 m."""
MAXIMUM_RANGE_M = 65535 * RANGE_STEP_M
KEYPOINT_STEP_M = 0.01
MAXIMUM_KEYPOINT_M = 32767 * KEYPOINT_STEP_M

RangeCodes = NDArray[np.uint16]

_RANGE_OF_CODE = (RANGE_STEP_M * np.arange(65536)).astype(np.float32)
_UPPER_TRIANGLE = np.array([0, 1, 2, 4, 5, 8])
_MIRROR = np.array([0, 1, 2, 1, 3, 4, 2, 4, 5])
_RAW_DEFLATE = -zlib.MAX_WBITS


def quantise(ranges_m: ArrayLike) -> RangeCodes:
    """Ranges (N,) in steps of 2 mm; 0 for what is no return (NaN, infinite, not positive, beyond 131.07 m)."""
    ranges = np.asarray(ranges_m, dtype=np.float64)
    steps = np.where((ranges > 0.0) & (ranges < MAXIMUM_RANGE_M + RANGE_STEP_M / 2), ranges, 0.0) / RANGE_STEP_M
    return np.rint(steps).astype(np.uint16)


def dequantise(codes: RangeCodes) -> Ranges:
    """Ranges (N,) in metres, read-only; ``quantise`` takes them back to the same codes."""
    return frozen(_RANGE_OF_CODE[codes], np.float32)


def pack_ranges(codes: RangeCodes) -> bytes:
    """Zigzag varints of the differences between neighbours, deflated."""
    compressor = zlib.compressobj(wbits=_RAW_DEFLATE)
    return compressor.compress(_delta_varints(codes).tobytes()) + compressor.flush()


def unpack_ranges(data: bytes) -> RangeCodes:
    """Inverse of ``pack_ranges``; never inflates to more than the limit, whatever ``data`` is.

    Raises:
        PacketError: ``data`` was not made by ``pack_ranges`` or holds too many ranges.
    """
    if len(data) > MAXIMUM_RANGES_BYTES:
        raise PacketError(f"keyscan: {len(data)} bytes of ranges, at most {MAXIMUM_RANGES_BYTES}")
    inflater = zlib.decompressobj(wbits=_RAW_DEFLATE)
    try:
        varints = inflater.decompress(data, MAXIMUM_RANGES_BYTES)
    except zlib.error as error:
        raise PacketError(f"keyscan: the ranges do not inflate ({error})") from error
    if not inflater.eof or inflater.unused_data:
        raise PacketError(
            f"keyscan: the ranges are cut off, followed by more, or inflate to over {MAXIMUM_RANGES_BYTES} bytes"
        )
    codes, valid = _from_delta_varints(np.frombuffer(varints, dtype=np.uint8), MAXIMUM_BEAMS)
    if not valid:
        raise PacketError(f"keyscan: the ranges are no differences of at most {MAXIMUM_BEAMS} 16-bit numbers")
    result: RangeCodes = codes
    return result


def pack_keypoints(keypoints: NDArray[np.float32]) -> bytes:
    """Keypoints (N, 2) or (N, 3) in metres, within the limit, rounded to 1 cm."""
    return np.rint(np.asarray(keypoints, dtype=np.float64) / KEYPOINT_STEP_M).astype("<i2").tobytes()


def unpack_keypoints(data: bytes, axes: int) -> NDArray[np.float32]:
    """Keypoints (N, axes) in metres from ``2 N axes`` bytes."""
    return frozen(np.frombuffer(data, dtype="<i2").reshape(-1, axes) * KEYPOINT_STEP_M, np.float32)


def pack_information(information: FloatArray) -> list[float]:
    """Upper triangle xx, xy, xt, yy, yt, tt of a matrix (3, 3), rounded to float32 (infinite beyond its range)."""
    with np.errstate(over="ignore"):
        upper: list[float] = information.ravel()[_UPPER_TRIANGLE].astype(np.float32).tolist()
    return upper


def unpack_information(upper: Sequence[float]) -> FloatArray:
    """The symmetric matrix (3, 3) of an upper triangle."""
    return frozen(np.array(upper)[_MIRROR].reshape(3, 3))


@njit(cache=True)
def _delta_varints(codes):  # type: ignore[no-untyped-def]
    out = np.empty(BYTES_PER_RANGE * len(codes), np.uint8)
    size = 0
    previous = np.int64(0)
    for code in codes:
        delta = np.int64(code) - previous
        previous = np.int64(code)
        value = (delta << 1) ^ (delta >> 63)
        while value >= 128:
            out[size] = (value & 127) | 128
            value >>= 7
            size += 1
        out[size] = value
        size += 1
    return out[:size]


@njit(cache=True)
def _from_delta_varints(data, limit):  # type: ignore[no-untyped-def]
    """The codes, and whether ``data`` is the one way to write them."""
    codes = np.empty(min(limit, len(data)), np.uint16)
    count = 0
    code = np.int64(0)
    value = np.int64(0)
    shift = 0
    for byte in data:
        value |= (np.int64(byte) & 127) << shift
        shift += 7
        if byte & 128:
            if shift == 7 * BYTES_PER_RANGE:
                return codes[:count], False
            continue
        code += (value >> 1) ^ -(value & 1)
        overlong = byte == 0 and shift > 7
        if overlong or code < 0 or code > 65535 or count == limit:
            return codes[:count], False
        codes[count] = code
        count += 1
        value = np.int64(0)
        shift = 0
    return codes[:count], shift == 0
