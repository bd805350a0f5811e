"""Linear prediction of descriptor bits for the entropy coder, with fixed weights.

The bits of a descriptor depend on one another, and neighbouring keypoints have similar descriptors. So bit b of a
descriptor is predicted to be 1 with probability 1 / (1 + exp(-z)), z = bias_b + sum_j own_jb x_j + sum_j neighbour_jb
y_j. Here x are the bits before it in the same descriptor, and y those of the descriptor at the nearest earlier
keypoint, as +1 and -1. The weights are part of the format, one set for each channel; `tools/descriptor_predictors.py`
fitted them. For descriptors of other detectors the coding is lossless as well, but needs more bytes.
"""

from functools import lru_cache
from importlib import resources
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fcslam.compiled import njit
from fcslam.records import CODE_BYTES, Channel, frozen
from fcslam.wire.entropy import Bytes, Coder, code_bit

WEIGHT_UNIT: Final = 1 / 64
"""Unit of ``own``, ``neighbour`` and z."""
BIAS_UNIT: Final = 1 / 16
_BITS: Final = 8 * CODE_BYTES
_LARGEST: Final = 512
"""|z| is limited to 8: no bit is impossible."""


class Predictor(NamedTuple):
    """The weights of one channel, in units of z. No sum of them leaves 16 bits, which a test checks."""

    bias: NDArray[np.int16]
    """Shape (256,)."""
    own: NDArray[np.int16]
    """Shape (256, 256): row j is the weight of bit j for the later bits."""
    neighbour: NDArray[np.int16]
    """Shape (256, 256): row j is the weight of bit j of the neighbour."""


class Sums(NamedTuple):
    """A predictor as the coder uses it: sums of four weights each, so that a descriptor takes 64 additions, not 256."""

    bias: NDArray[np.int16]
    """Shape (256,)."""
    own: NDArray[np.int16]
    """Shape (256, 256), for a reader, who learns one bit at a time."""
    of_own: NDArray[np.int16]
    """Shape (64, 16, 256): for each four consecutive bits, what each of their values adds."""
    of_neighbour: NDArray[np.int16]


@lru_cache
def sums_of(channel: Channel) -> Sums:
    """The weights of one channel, summed."""
    predictor = predictor_of(channel)
    return Sums(predictor.bias, predictor.own, _sums(predictor.own), _sums(predictor.neighbour))


def _sums(weights: NDArray[np.int16]) -> NDArray[np.int16]:
    signs = 2 * np.unpackbits(np.arange(16, dtype=np.uint8)[:, np.newaxis], axis=1)[:, 4:].astype(np.int16) - 1
    return frozen(signs @ weights.reshape(-1, 4, _BITS), np.int16)


@lru_cache
def predictor_of(channel: Channel) -> Predictor:
    """The weights of one channel."""
    with resources.as_file(resources.files(__package__) / "predictors" / f"{channel}.npy") as path:
        table = np.load(path, allow_pickle=False).astype(np.int16)
    scale = round(BIAS_UNIT / WEIGHT_UNIT)
    return Predictor(frozen(scale * table[0], np.int16), frozen(table[1:257], np.int16), frozen(table[257:], np.int16))


PROBABILITIES: Final = frozen(
    np.rint(65536 / (1.0 + np.exp(-WEIGHT_UNIT * np.arange(-_LARGEST, _LARGEST + 1)))), np.int64
)
"""Probability of a 1 in units of 1/65536, for z from the smallest to the largest."""


@njit(nogil=True)
def code_descriptors(
    coder: Coder,
    data: Bytes,
    bits: NDArray[np.uint8],
    keypoints: NDArray[np.int64],
    bias: NDArray[np.int16],
    own: NDArray[np.int16],
    of_own: NDArray[np.int16],
    of_neighbour: NDArray[np.int16],
    probabilities: NDArray[np.int64],
) -> Coder:
    """Write ``bits`` (N, 256), or read them in place; both sides know ``keypoints`` (N, axes)."""
    for i in range(len(bits)):
        expected = bias.copy()
        if i > 0:
            _add(expected, of_neighbour, bits[nearest_before(keypoints, i)])
        if not coder.reads:
            _add(expected, of_own, bits[i])
        for b in range(_BITS):
            z = min(max(int(expected[b]), -_LARGEST), _LARGEST)
            coder, bit = code_bit(coder, data, probabilities[z + _LARGEST], bits[i, b])
            if coder.reads:
                bits[i, b] = bit
                _add_bit(expected, own[b], bit)
    return coder


@njit(nogil=True, allocates=False)
def nearest_before(keypoints: NDArray[np.int64], i: int) -> int:
    """Index of the nearest of the ``keypoints`` (N, axes), in ascending order, before keypoint i > 0; of several the
    first."""
    nearest, least = 0, np.int64(1) << 62
    for k in range(i - 1, -1, -1):
        ahead = keypoints[i, 0] - keypoints[k, 0]
        if ahead * ahead > least:
            break
        distance = np.int64(0)
        for axis in range(keypoints.shape[1]):
            difference = keypoints[k, axis] - keypoints[i, axis]
            distance += difference * difference
        if distance <= least:
            nearest, least = k, distance
    return nearest


@njit(nogil=True, allocates=False)
def _add(expected: NDArray[np.int16], sums: NDArray[np.int16], bits: NDArray[np.uint8]) -> None:
    """Add the weights of all ``bits`` (256,), by their ``sums`` (64, 16, 256)."""
    for four in range(0, _BITS // 4, 4):  # four at a time: ``expected`` is read and written once for them
        a, b, c, d = _value(bits, four), _value(bits, four + 1), _value(bits, four + 2), _value(bits, four + 3)
        for k in range(_BITS):  # a constant, so that the loop is unrolled
            expected[k] += sums[four, a, k] + sums[four + 1, b, k] + sums[four + 2, c, k] + sums[four + 3, d, k]


@njit(nogil=True, allocates=False)
def _value(bits: NDArray[np.uint8], four: int) -> int:
    """Four consecutive bits as a number."""
    k = 4 * four
    return int(bits[k] << 3 | bits[k + 1] << 2 | bits[k + 2] << 1 | bits[k + 3])


@njit(nogil=True, allocates=False)
def _add_bit(expected: NDArray[np.int16], weights: NDArray[np.int16], bit: int) -> None:
    """Add the weights (256,) of one bit, which has none for itself and earlier ones."""
    sign = np.int16(1) if bit else np.int16(-1)
    for k in range(_BITS):
        expected[k] += sign * weights[k]
