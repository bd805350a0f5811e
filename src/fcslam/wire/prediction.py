"""What the bits of a descriptor let expect of one another: a fixed linear prediction of each, for the entropy coder.

Descriptors are far from noise. Their bits depend on one another, as neighbouring comparisons of a patch or channels of
a network do, and keypoints next to each other look alike. So bit b of a descriptor is taken to be 1 with probability
1 / (1 + exp(-z)), z = bias_b + sum_j own_jb x_j + sum_j neighbour_jb y_j, where x are the bits before it in the same
descriptor, y those of the descriptor at the nearest keypoint that came before, and bits count as +1 and -1. The weights
are part of the format, one set a channel; `tools/descriptor_predictors.py` fitted them. Descriptors of another detector
than they were fitted to lose nothing but bytes.
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
"""Of ``own`` and ``neighbour``, and of z."""
BIAS_UNIT: Final = 1 / 16
_LARGEST: Final = 512
"""|z| beyond 8 is cut: no bit is believed impossible."""


class Predictor(NamedTuple):
    """The weights of one channel, in units of z."""

    bias: NDArray[np.int32]
    """Shape (256,)."""
    own: NDArray[np.int32]
    """Shape (256, 256): row j is what bit j tells about the later ones."""
    neighbour: NDArray[np.int32]
    """Shape (256, 256): row j is what bit j of the neighbour tells."""


@lru_cache
def predictor_of(channel: Channel) -> Predictor:
    """The weights for a channel's descriptors."""
    with resources.as_file(resources.files(__package__) / "predictors" / f"{channel}.npy") as path:
        table = np.load(path, allow_pickle=False).astype(np.int32)
    scale = round(BIAS_UNIT / WEIGHT_UNIT)
    return Predictor(frozen(scale * table[0], np.int32), frozen(table[1:257], np.int32), frozen(table[257:], np.int32))


PROBABILITIES: Final = frozen(
    np.rint(65536 / (1.0 + np.exp(-WEIGHT_UNIT * np.arange(-_LARGEST, _LARGEST + 1)))), np.int64
)
"""Of a one in 1/65536, by z from the least to the largest."""


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
    """Write ``bits`` (N, 256) or fill them with what is read; ``keypoints`` (N, axes) are known to both sides."""
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
    """Which of the ``keypoints`` (N, axes) before keypoint i > 0 is the nearest to it; of several the first."""
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
    """Over all of them: what was expected of the bits before does not matter any more, and this way it is fastest."""
    if bit:
        for b in range(len(expected)):
            expected[b] += weights[b]
    else:
        for b in range(len(expected)):
            expected[b] -= weights[b]
