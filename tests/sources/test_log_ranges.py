"""Ranges that are parsed together are those that are parsed one by one."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fcslam.errors import SourceError
from fcslam.sources.faults import Audit
from fcslam.sources.logs.dialect import OdometryLine, ScanLine
from fcslam.sources.logs.ranges import parse_ahead, parse_ranges, plain_numbers

POSE = (0.0, 0.0, 0.0)
WHOLE = st.integers(0, 10**7).map(str)
DECIMAL = st.tuples(WHOLE, st.text("0123456789", max_size=7)).map(".".join)


def scan(text, beams=2):
    return ScanLine(1.0, POSE, POSE, beams, text)


@given(st.lists(DECIMAL, min_size=1) | st.lists(WHOLE, min_size=1))
def test_plain_numbers_are_exactly_those_of_float(words):
    np.testing.assert_array_equal(plain_numbers(" ".join(words).encode()), [float(word) for word in words])


@pytest.mark.parametrize(
    "text",
    [b"1.0 nan", b"1.0 -2.0", b"1e3", b"1.0  2.0", b" 1.0", b"1.0 ", b"1.0 2", b"1..0 2", b"1.0.0", b".5 1.0", b".",
     b"1.0\t2.0", b"1.0 0.12345678901234567", b"1.0 +2.0"],
)  # fmt: skip
def test_other_texts_are_left_to_float(text):
    assert plain_numbers(text) is None


@pytest.mark.parametrize("odd", [b"1.5 nan", b"-1.0 3.25", b"1.5 9999999.0", b"2.5  3.5"])
def test_a_batch_with_an_odd_scan_gives_what_each_scan_gives_alone(odd):
    plain = scan(b"0.29 81.83")
    for lines in ([(1, plain), (2, OdometryLine(1.0, POSE)), (3, plain)], [(1, plain), (2, scan(odd))]):
        for (number, line), (same, ahead) in zip(lines, parse_ahead(lines, 0.01), strict=True):
            assert number == same
            if isinstance(line, ScanLine):
                alone, together = Audit(), Audit()
                expected = parse_ranges(line, 0.01, number, alone)
                ranges_m = parse_ranges(ahead, 0.01, number, together)
                np.testing.assert_array_equal(ranges_m, expected)
                assert ranges_m.dtype == np.float32
                assert not ranges_m.flags.writeable
                assert together.faults() == alone.faults()


def test_scans_of_different_beam_counts_keep_their_own_ranges():
    lines = [(1, scan(b"1.0 2.0 3.0", 3)), (2, None), (3, scan(b"4.0 5.0"))]
    first, broken, second = parse_ahead(lines, 1.0)
    assert first[1].ranges_m.tolist() == [1.0, 2.0, 3.0]
    assert broken == (2, None)
    assert second[1].ranges_m.tolist() == [4.0, 5.0]


def test_the_lines_before_a_damage_are_read():
    def lines():
        yield 1, scan(b"1.0 2.0")
        raise SourceError("damaged")

    read = parse_ahead(lines(), 1.0)
    assert next(read)[1].ranges_m.tolist() == [1.0, 2.0]
    with pytest.raises(SourceError):
        next(read)


def test_long_lines_are_parsed_a_few_at_a_time():
    taken = 0

    def lines():
        nonlocal taken
        for taken in range(1, 100):
            yield taken, scan(b"1 " * 50_000 + b"1", 50_001)

    next(parse_ahead(lines(), 1.0))
    assert taken < 5
