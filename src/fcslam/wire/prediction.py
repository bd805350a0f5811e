"""Linear prediction of descriptor bits for the entropy coder, with fixed weights.

The bits of a descriptor depend on one another, as neighbouring comparisons of a patch or channels of a network do, and
neighbouring keypoints have similar descriptors. So bit b of a descriptor is predicted to be 1 with probability
1 / (1 + exp(-z)), z = bias_b + sum_j own_jb x_j + sum_j neighbour_jb y_j, where x are the bits before it in the same
descriptor, y those of the descriptor at the nearest earlier keypoint, and bits count as +1 and -1. The weights are part
of the format, one set for each channel; `tools/descriptor_predictors.py` fitted them. For descriptors of other
detectors the coding is lossless as well, but needs more bytes.
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
    neighbour: NDArray[np.int16],
    probabilities: NDArray[np.int64],
) -> Coder:
    """Write ``bits`` (N, 256), or read them in place; both sides know ``keypoints`` (N, axes)."""
    for i in range(len(bits)):
        expected = bias.copy()
        if i > 0:
            _add(expected, neighbour, bits[nearest_before(keypoints, i)])
        if not coder.reads:
            _add(expected, own, bits[i])
        for b in range(_BITS):
            z = min(max(int(expected[b]), -_LARGEST), _LARGEST)
            coder, bit = code_bit(coder, data, probabilities[z + _LARGEST], bits[i, b])
            if coder.reads:
                bits[i, b] = bit
                _add(expected, own[b : b + 1], bits[i, b : b + 1])
    return coder


@njit(nogil=True)
def nearest_before(keypoints: NDArray[np.int64], i: int) -> int:
    """Index of the nearest of the ``keypoints`` (N, axes) before keypoint i > 0; of several the first."""
    nearest, least = 0, np.int64(1) << 62
    for k in range(i):
        distance = np.int64(0)
        for axis in range(keypoints.shape[1]):
            difference = keypoints[k, axis] - keypoints[i, axis]
            distance += difference * difference
        if distance < least:
            nearest, least = k, distance
    return nearest


@njit(nogil=True)
def _add(expected: NDArray[np.int16], weights: NDArray[np.int16], bits: NDArray[np.uint8]) -> None:
    """Add the weights (K, 256) of some bits (K,). A bit has no weight for itself and earlier ones."""
    for j in range(len(bits)):
        sign = np.int16(1) if bits[j] else np.int16(-1)
        for b in range(_BITS):  # a constant, so that the loop is unrolled
            expected[b] += sign * weights[j, b]
