"""Quantisation of ranges, keypoints and information matrices to the precision of the wire.

A robot maps with the ranges that it sends, ``rounded``, so that it and the cloud see the same numbers.
"""

from array import array
from collections.abc import Sequence
from functools import cache
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fcslam.compiled import njit
from fcslam.records import FloatArray, Ranges, frozen
from fcslam.wire.streams import KeypointCodes, RangeCodes

RANGE_STEP_M: Final = 0.002
"""Rounding adds a standard deviation of 0.6 mm to the 10-30 mm of a 2D LiDAR; 16 bits then reach 131 m."""
_NO_RETURN: Final = 65535
MAXIMUM_RANGE_M: Final = (_NO_RETURN - 1) * RANGE_STEP_M
KEYPOINT_STEP_M = 0.01
MAXIMUM_KEYPOINT_M = 32767 * KEYPOINT_STEP_M

_RANGE_OF_CODE = (RANGE_STEP_M * np.arange(65536)).astype(np.float32)
_RANGE_OF_CODE[_NO_RETURN] = np.inf


def quantise(ranges_m: ArrayLike) -> RangeCodes:
    """Ranges (N,) in metres as steps of 2 mm (N,).

    65535 stands for no return (inf), 0 for an invalid range (NaN, not positive, over 131.068 m).
    """
    codes: RangeCodes = _quantise(np.array(ranges_m, dtype=np.float64))  # a writable copy: code is compiled once
    return codes


@njit
def _quantise(ranges):  # type: ignore[no-untyped-def]
    codes = np.zeros(len(ranges), np.uint16)
    for i in range(len(ranges)):
        codes[i] = _code_of(ranges[i])
    return codes


@njit(allocates=False)
def _code_of(r):  # type: ignore[no-untyped-def]
    if r == np.inf:
        return _NO_RETURN
    if 0.0 < r < MAXIMUM_RANGE_M + RANGE_STEP_M / 2:  # false for NaN
        return int(np.rint(r / RANGE_STEP_M))
    return 0


def rounded(ranges_m: ArrayLike, max_range_m: float) -> Ranges:
    """Ranges (N,) in metres as a packet carries them, ``dequantise(quantise(ranges_m))``, read-only.

    Those at the maximum or above are 0, but no return is inf. The maximum is rounded as the ranges are: 5.6 m in single
    precision is below 5.6 m, and it is not a return. It is compared before the ranges are rounded to the steps of the
    wire, which may take it below the maximum as well.
    """
    ranges = np.array(ranges_m, dtype=np.float64)  # as in ``quantise``
    result: Ranges = _rounded(ranges, float(np.float32(max_range_m)))
    result.setflags(write=False)
    return result


@njit
def _rounded(ranges, limit):  # type: ignore[no-untyped-def]
    result = np.zeros(len(ranges), np.float32)
    for i in range(len(ranges)):
        r = ranges[i]
        if r == np.inf:
            result[i] = np.inf
        elif r < limit:
            result[i] = np.float32(RANGE_STEP_M * _code_of(r))
    return result


def dequantise(codes: RangeCodes) -> Ranges:
    """Ranges (N,) in metres, read-only; ``quantise`` takes them back to the same codes."""
    return frozen(_RANGE_OF_CODE[codes], np.float32)


def quantise_keypoints(keypoints: NDArray[np.float32]) -> KeypointCodes:
    """Keypoints (N, 2) or (N, 3) in metres, within the limit, in steps of 1 cm."""
    return np.rint(np.asarray(keypoints, dtype=np.float64) / KEYPOINT_STEP_M).astype(np.int16)


def dequantise_keypoints(codes: KeypointCodes) -> NDArray[np.float32]:
    """Keypoints (N, axes) in metres, read-only."""
    return frozen(codes * KEYPOINT_STEP_M, np.float32)


def pack_information(information: FloatArray) -> list[float]:
    """Upper triangle xx, xy, xt, yy, yt, tt of a matrix (d, d), rounded to float32 (infinite beyond its range)."""
    rows = information.tolist()
    return array("f", [number for k, row in enumerate(rows) for number in row[k:]]).tolist()


def unpack_information(upper: Sequence[float]) -> FloatArray:
    """The symmetric matrix (d, d) of an upper triangle of 6 or 21 numbers."""
    return frozen(np.array(upper)[_mirror(3 if len(upper) == 6 else 6)])


@cache
def _mirror(freedom: int) -> NDArray[np.int64]:
    places = np.zeros((freedom, freedom), np.int64)
    row, column = np.triu_indices(freedom)
    places[row, column] = places[column, row] = np.arange(len(row))
    return places
