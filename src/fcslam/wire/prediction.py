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
from numba import njit
from numpy.typing import NDArray

from fcslam.records import Channel, frozen
from fcslam.wire.entropy import Bytes, Coder, code_bit

WEIGHT_UNIT: Final = 1 / 64
"""Unit of ``own``, ``neighbour`` and z."""
BIAS_UNIT: Final = 1 / 16
_LARGEST: Final = 512
"""|z| is limited to 8: no bit is impossible."""


class Predictor(NamedTuple):
    """The weights of one channel, in units of z."""

    bias: NDArray[np.int32]
    """Shape (256,)."""
    own: NDArray[np.int32]
    """Shape (256, 256): row j is the weight of bit j for the later bits."""
    neighbour: NDArray[np.int32]
    """Shape (256, 256): row j is the weight of bit j of the neighbour."""


@lru_cache
def predictor_of(channel: Channel) -> Predictor:
    """The weights of one channel."""
    with resources.as_file(resources.files(__package__) / "predictors" / f"{channel}.npy") as path:
        table = np.load(path, allow_pickle=False).astype(np.int32)
    scale = round(BIAS_UNIT / WEIGHT_UNIT)
    return Predictor(frozen(scale * table[0], np.int32), frozen(table[1:257], np.int32), frozen(table[257:], np.int32))


PROBABILITIES: Final = frozen(
    np.rint(65536 / (1.0 + np.exp(-WEIGHT_UNIT * np.arange(-_LARGEST, _LARGEST + 1)))), np.int64
)
"""Probability of a 1 in units of 1/65536, for z from the smallest to the largest."""


@njit(cache=True, nogil=True)
def code_descriptors(
    coder: Coder,
    data: Bytes,
    bits: NDArray[np.uint8],
    keypoints: NDArray[np.int64],
    bias: NDArray[np.int32],
    own: NDArray[np.int32],
    neighbour: NDArray[np.int32],
    probabilities: NDArray[np.int64],
) -> None:
    """Write ``bits`` (N, 256), or read them in place; both sides know ``keypoints`` (N, axes)."""
    for i in range(len(bits)):
        expected = bias.copy()
        if i > 0:
            for j, bit in enumerate(bits[nearest_before(keypoints, i)]):
                _add(expected, neighbour[j], bit)
        for b in range(len(expected)):
            z = min(max(expected[b], -_LARGEST), _LARGEST)
            bits[i, b] = code_bit(coder, data, probabilities[z + _LARGEST], bits[i, b])
            _add(expected, own[b], bits[i, b])


@njit(cache=True, nogil=True)
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


@njit(cache=True, nogil=True)
def _add(expected: NDArray[np.int32], weights: NDArray[np.int32], bit: int) -> None:
    """Add the weights of one bit. Earlier bits are included, as one loop without a condition is fastest."""
    if bit:
        for b in range(len(expected)):
            expected[b] += weights[b]
    else:
        for b in range(len(expected)):
            expected[b] -= weights[b]
