"""Adaptive arithmetic coder for bits and integers.

Functions with a parameter ``bit`` or ``value`` write it; if the coder reads, they ignore it and return what they read.
So one function defines both directions. The arithmetic is in integers, so results are the same on every machine.

The coder is the carry-less range coder of Mahoney's PAQ: an interval of 32-bit numbers shrinks by the probability of
each bit, and leading bytes that its ends share are output. A stream ends with the fewest bytes that name a number in
the last interval, without trailing zeros; any other ending is refused. So each content has exactly one stream.
"""

from typing import Final

import numpy as np
from numba import njit
from numpy.typing import NDArray

Coder = NDArray[np.int64]
"""State: [reads, low, high, number read or length without zeros at the end, position, bytes available]."""
Bytes = NDArray[np.uint8]
Model = NDArray[np.int64]
"""Shape (contexts, 2): probability of a one in 1/65536, and how many bits it was learnt from."""

_READS, _LOW, _HIGH, _NUMBER, _POSITION, _SIZE = range(6)
_ONE: Final = 65536
_LEAST: Final = 32
"""Least probability of a bit: none is impossible."""
_MEMORY: Final = 50
"""A context adapts to about this many recent bits."""
_MOST_DIGITS: Final = 20
CONTEXTS_OF_NUMBER: Final = 2 * _MOST_DIGITS + 2


@njit(cache=True, nogil=True)
def writer(size: int) -> tuple[Coder, Bytes]:
    """A coder that writes at most ``size`` bytes, and where it writes them."""
    return np.array([0, 0, 0xFFFFFFFF, 0, 0, size]), np.zeros(size, np.uint8)


@njit(cache=True, nogil=True)
def reader(data: Bytes) -> Coder:
    """A coder that reads ``data``."""
    coder = np.array([1, 0, 0xFFFFFFFF, 0, 0, len(data)])
    for _ in range(4):
        _next_byte(coder, data)
    return coder


@njit(cache=True, nogil=True)
def fresh_model(contexts: int) -> Model:
    """A model without any data: all bits have probability 1/2."""
    model = np.zeros((contexts, 2), np.int64)
    model[:, 0] = _ONE // 2
    return model


@njit(cache=True, nogil=True)
def code_bit(coder: Coder, data: Bytes, probability: int, bit: int) -> int:
    """One bit that is 1 with ``probability`` in 1/65536, between 1 and 65535."""
    middle = coder[_LOW] + (((coder[_HIGH] - coder[_LOW]) * probability) >> 16)
    if coder[_READS]:
        bit = int(coder[_NUMBER] <= middle)
    if bit:
        coder[_HIGH] = middle
    else:
        coder[_LOW] = middle + 1
    while (coder[_LOW] ^ coder[_HIGH]) >> 24 == 0:
        if coder[_READS]:
            _next_byte(coder, data)
        else:
            _put_byte(coder, data, coder[_LOW] >> 24)
        coder[_LOW] = (coder[_LOW] & 0xFFFFFF) << 8
        coder[_HIGH] = (coder[_HIGH] & 0xFFFFFF) << 8 | 0xFF
    return bit


@njit(cache=True, nogil=True)
def code_learnt(coder: Coder, data: Bytes, model: Model, context: int, bit: int) -> int:
    """One bit by the probability that its context has had so far."""
    probability, seen = model[context]
    bit = code_bit(coder, data, min(max(probability, _LEAST), _ONE - _LEAST), bit)
    model[context, 0] += (2 * (bit * _ONE - probability)) // (2 * seen + 3)
    model[context, 1] = min(seen + 1, _MEMORY)
    return bit


@njit(cache=True, nogil=True)
def code_number(coder: Coder, data: Bytes, model: Model, context: int, value: int) -> int:
    """A number in [0, 2^20), in ``CONTEXTS_OF_NUMBER`` contexts: Elias' gamma code, whose first bits are learnt."""
    value += 1
    digits = 0
    while digits < _MOST_DIGITS and code_learnt(coder, data, model, context + digits, int(value >> (digits + 1) > 0)):
        digits += 1
    result = 1
    for digit in range(digits - 1, -1, -1):
        bit = (value >> digit) & 1
        if digit == digits - 1:
            bit = code_learnt(coder, data, model, context + _MOST_DIGITS + digits, bit)
        else:
            bit = code_bit(coder, data, _ONE // 2, bit)
        result = 2 * result + bit
    return result - 1


@njit(cache=True, nogil=True)
def code_signed(coder: Coder, data: Bytes, model: Model, context: int, value: int) -> int:
    """A number in (-2^19, 2^19): 0, -1, 1, -2, 2 ... as 0, 1, 2, 3, 4 ..."""
    number = code_number(coder, data, model, context, (value << 1) ^ (value >> 63))
    return int((number >> 1) ^ -(number & 1))


@njit(cache=True, nogil=True)
def written(coder: Coder, data: Bytes) -> int:
    """End the stream: how many bytes it has, or -1 if it has more than there was room for."""
    if coder[_LOW] > 0:
        _put_byte(coder, data, coder[_HIGH] >> 24)
    return int(coder[_NUMBER]) if coder[_NUMBER] <= coder[_SIZE] else -1


@njit(cache=True, nogil=True)
def is_at_end(coder: Coder, data: Bytes) -> bool:
    """Whether the stream that was read has this end and no other."""
    ending = coder[_HIGH] >> 24 << 24 if coder[_LOW] > 0 else 0
    shortest = len(data) == 0 or data[len(data) - 1] != 0
    return bool(shortest and coder[_NUMBER] == ending and coder[_POSITION] - 4 >= len(data) - 1)


@njit(cache=True, nogil=True)
def _next_byte(coder: Coder, data: Bytes) -> None:
    byte = np.int64(data[coder[_POSITION]]) if coder[_POSITION] < coder[_SIZE] else np.int64(0)
    coder[_NUMBER] = (coder[_NUMBER] & 0xFFFFFF) << 8 | byte
    coder[_POSITION] += 1


@njit(cache=True, nogil=True)
def _put_byte(coder: Coder, data: Bytes, byte: int) -> None:
    if coder[_POSITION] < coder[_SIZE]:
        data[coder[_POSITION]] = byte
    coder[_POSITION] += 1
    if byte != 0:
        coder[_NUMBER] = coder[_POSITION]
