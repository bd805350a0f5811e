"""Adaptive arithmetic coder for bits and integers.

Functions with a parameter ``bit`` or ``value`` write it; if the coder reads, they ignore it and return what they read.
So one function defines both directions. The arithmetic is in integers, so results are the same on every machine.

The coder is the carry-less range coder of Mahoney's PAQ: an interval of 32-bit numbers shrinks by the probability of
each bit, and leading bytes that its ends share are output. A stream ends with the fewest bytes that name a number in
the last interval, without trailing zeros; any other ending is refused. So each content has exactly one stream.
"""

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fcslam.compiled import njit


class Coder(NamedTuple):
    """State of a coder. Functions return the next one: compiled code then keeps it in registers."""

    reads: bool
    low: int
    high: int
    """Ends of the interval."""
    number: int
    """Reading: the number read. Writing: length of the stream without zeros at its end."""
    position: int
    """Bytes read or written."""


Bytes = NDArray[np.uint8]
Model = NDArray[np.int64]
"""Shape (contexts, 2): probability of a one in 1/65536, and how many bits it was learnt from."""

_ONE: Final = 65536
_LEAST: Final = 32
"""Least probability of a bit: none is impossible."""
_MEMORY: Final = 50
"""A context adapts to about this many recent bits."""
_MOST_DIGITS: Final = 20
CONTEXTS_OF_NUMBER: Final = 2 * _MOST_DIGITS + 2


@njit(nogil=True)
def writer() -> Coder:
    """A coder that writes."""
    return Coder(False, 0, 0xFFFFFFFF, 0, 0)


@njit(nogil=True)
def reader(data: Bytes) -> Coder:
    """A coder that reads ``data``."""
    number = 0
    for position in range(4):
        number = number << 8 | _byte_at(data, position)
    return Coder(True, 0, 0xFFFFFFFF, number, 4)


@njit(nogil=True)
def fresh_model(contexts: int) -> Model:
    """A model without any data: all bits have probability 1/2."""
    model = np.zeros((contexts, 2), np.int64)
    for context in range(contexts):
        model[context, 0] = _ONE // 2
    return model


@njit(nogil=True, allocates=False)
def code_bit(coder: Coder, data: Bytes, probability: int, bit: int) -> tuple[Coder, int]:
    """One bit that is 1 with ``probability`` in 1/65536, between 1 and 65535."""
    reads, low, high, number, position = coder
    middle = low + (((high - low) * probability) >> 16)
    if reads:
        bit = int(number <= middle)
    # Selections instead of a branch, which a processor could not predict.
    high = middle if bit else high
    low = low if bit else middle + 1
    while (low ^ high) >> 24 == 0:
        if reads:
            number = (number & 0xFFFFFF) << 8 | _byte_at(data, position)
        else:
            number = _put_byte(data, position, low >> 24, number)
        position += 1
        low = (low & 0xFFFFFF) << 8
        high = (high & 0xFFFFFF) << 8 | 0xFF
    return Coder(reads, low, high, number, position), bit


@njit(nogil=True, allocates=False)
def code_learnt(coder: Coder, data: Bytes, model: Model, context: int, bit: int) -> tuple[Coder, int]:
    """One bit by the probability that its context has had so far."""
    probability, seen = model[context, 0], model[context, 1]
    coder, bit = code_bit(coder, data, min(max(probability, _LEAST), _ONE - _LEAST), bit)
    model[context, 0] += (2 * (bit * _ONE - probability)) // (2 * seen + 3)
    model[context, 1] = min(seen + 1, _MEMORY)
    return coder, bit


@njit(nogil=True, allocates=False)
def code_number(coder: Coder, data: Bytes, model: Model, context: int, value: int) -> tuple[Coder, int]:
    """A number in [0, 2^20), in ``CONTEXTS_OF_NUMBER`` contexts: Elias' gamma code, whose first bits are learnt."""
    value += 1
    digits, more = 0, 1
    while more and digits < _MOST_DIGITS:
        coder, more = code_learnt(coder, data, model, context + digits, int(value >> (digits + 1) > 0))
        digits += more
    result = 1
    for digit in range(digits - 1, -1, -1):
        bit = (value >> digit) & 1
        if digit == digits - 1:
            coder, bit = code_learnt(coder, data, model, context + _MOST_DIGITS + digits, bit)
        else:
            coder, bit = code_bit(coder, data, _ONE // 2, bit)
        result = 2 * result + bit
    return coder, result - 1


@njit(nogil=True, allocates=False)
def code_signed(coder: Coder, data: Bytes, model: Model, context: int, value: int) -> tuple[Coder, int]:
    """A number in (-2^19, 2^19): 0, -1, 1, -2, 2 ... as 0, 1, 2, 3, 4 ..."""
    coder, number = code_number(coder, data, model, context, (value << 1) ^ (value >> 63))
    return coder, int((number >> 1) ^ -(number & 1))


@njit(nogil=True, allocates=False)
def written(coder: Coder, data: Bytes) -> int:
    """End the stream: how many bytes it has, or -1 if it has more than there was room for."""
    size = coder.number
    if coder.low > 0:
        size = _put_byte(data, coder.position, coder.high >> 24, size)
    return int(size) if size <= len(data) else -1


@njit(nogil=True, allocates=False)
def is_at_end(coder: Coder, data: Bytes) -> bool:
    """Whether the stream that was read has this end and no other."""
    ending = coder.high >> 24 << 24 if coder.low > 0 else 0
    shortest = len(data) == 0 or data[len(data) - 1] != 0
    return bool(shortest and coder.number == ending and coder.position - 4 >= len(data) - 1)


@njit(nogil=True, allocates=False)
def _byte_at(data: Bytes, position: int) -> int:
    """A byte of a stream, which zeros follow."""
    return int(data[position]) if position < len(data) else 0


@njit(nogil=True, allocates=False)
def _put_byte(data: Bytes, position: int, byte: int, size: int) -> int:
    """Write a byte if there is room; returns the length without zeros at the end, which was ``size`` before."""
    if position < len(data):
        data[position] = byte
    return position + 1 if byte != 0 else size
