"""The arithmetic coder: written values come back, in hardly more bits than their information, and in one way only."""

import math

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from fcslam.wire.entropy import (
    CONTEXTS_OF_NUMBER,
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

ROOM = 4000
BITS = st.lists(st.tuples(st.integers(1, 65535), st.booleans()), max_size=200)


def write(code, contents):
    coder, data = writer(), np.zeros(ROOM, np.uint8)
    for content in contents:
        coder, _ = code(coder, data, content)
    return data[: written(coder, data)]


def read(code, data, count):
    """The content of a stream, and whether it ends there."""
    data = np.frombuffer(bytearray(data), np.uint8)
    coder, contents = reader(data), []
    for _ in range(count):
        coder, content = code(coder, data, 0)
        contents.append(content)
    return contents, is_at_end(coder, data)


@given(BITS)
def test_bits_come_back_and_cost_what_they_are_worth(bits):
    stream = write(lambda coder, data, content: code_bit(coder, data, content[0], int(content[1])), bits)
    probabilities = iter([probability for probability, _ in bits])
    again = read(lambda coder, data, _: code_bit(coder, data, next(probabilities), 0), stream, len(bits))
    assert again == ([bit for _, bit in bits], True)
    worth = sum(-math.log2((p if bit else 65536 - p) / 65536) for p, bit in bits)
    assert len(stream) <= worth / 8 + 1 + 0.01 * len(bits)


@given(st.lists(st.integers(0, 2**20 - 1), max_size=60))
def test_numbers_come_back(numbers):
    model = fresh_model(CONTEXTS_OF_NUMBER)
    stream = write(lambda coder, data, number: code_number(coder, data, model, 0, number), numbers)
    model = fresh_model(CONTEXTS_OF_NUMBER)
    again = read(lambda coder, data, number: code_number(coder, data, model, 0, number), stream, len(numbers))
    assert again == (numbers, True)


@given(st.lists(st.integers(-(2**19) + 1, 2**19 - 1), max_size=60))
def test_signed_numbers_come_back(numbers):
    model = fresh_model(CONTEXTS_OF_NUMBER)
    stream = write(lambda coder, data, number: code_signed(coder, data, model, 0, number), numbers)
    model = fresh_model(CONTEXTS_OF_NUMBER)
    again = read(lambda coder, data, number: code_signed(coder, data, model, 0, number), stream, len(numbers))
    assert again == (numbers, True)


@given(st.binary(max_size=12), st.integers(0, 12))
def test_a_content_has_one_stream(stream, count):
    """Any bytes are refused at the end, or are what writing the content gives."""
    model = fresh_model(CONTEXTS_OF_NUMBER)
    numbers, ended = read(lambda coder, data, number: code_number(coder, data, model, 0, number), stream, count)
    model = fresh_model(CONTEXTS_OF_NUMBER)
    again = write(lambda coder, data, number: code_number(coder, data, model, 0, number), numbers).tobytes()
    assert ended == (again == stream)


def test_what_repeats_is_learnt():
    model = fresh_model(1)
    stream = write(lambda coder, data, bit: code_learnt(coder, data, model, 0, bit), [1] * 1000)
    assert len(stream) < 8
    model = fresh_model(1)
    assert read(lambda coder, data, bit: code_learnt(coder, data, model, 0, bit), stream, 1000) == ([1] * 1000, True)


def test_what_has_no_room_is_not_written():
    coder, data = writer(), np.zeros(2, np.uint8)
    for _ in range(100):
        coder, _ = code_bit(coder, data, 65535, 0)
    assert written(coder, data) == -1


def test_a_plain_reader_of_the_published_rules_agrees():
    """Whole numbers of Python, nothing shared with the coder."""
    numbers = [int(n) for n in np.random.default_rng(0).geometric(0.01, 300)]
    model = fresh_model(CONTEXTS_OF_NUMBER)
    stream = write(lambda coder, data, number: code_number(coder, data, model, 0, number), numbers)
    assert PlainReader(stream.tobytes()).numbers(len(numbers)) == numbers


class PlainReader:
    """Reads numbers as docs/reference/wire.md describes them."""

    def __init__(self, data):
        self.number = int.from_bytes(data + bytes(ROOM), "big")
        self.length = 8 * (len(data) + ROOM)
        self.low, self.high, self.done = 0, 2**32 - 1, 0
        self.contexts = {}

    def bit(self, probability):
        middle = self.low + ((self.high - self.low) * probability >> 16)
        window = self.number >> (self.length - 32 - self.done) & 0xFFFFFFFF
        bit = window <= middle
        self.low, self.high = (self.low, middle) if bit else (middle + 1, self.high)
        while self.low >> 24 == self.high >> 24:
            self.low = self.low << 8 & 0xFFFFFFFF
            self.high = self.high << 8 & 0xFFFFFFFF | 0xFF
            self.done += 8
        return int(bit)

    def learnt(self, context):
        probability, seen = self.contexts.get(context, (32768, 0))
        bit = self.bit(min(max(probability, 32), 65504))
        step = math.floor(2 * (65536 * bit - probability) / (2 * seen + 3))
        self.contexts[context] = probability + step, min(seen + 1, 50)
        return bit

    def numbers(self, count):
        result = []
        for _ in range(count):
            digits = 0
            while digits < 20 and self.learnt(("longer", digits)):
                digits += 1
            text = "1"
            for digit in range(digits):
                text += str(self.learnt(("first", digits)) if digit == 0 else self.bit(32768))
            result.append(int(text, 2) - 1)
        return result
