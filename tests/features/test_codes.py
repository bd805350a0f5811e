import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fcslam.features.codes import code_words, hamming_matrix, mutual_matches


def random_codes(rng, count, distinct_bytes=32):
    """Few distinct bytes make many equal distances."""
    codes = np.zeros((count, 32), np.uint8)
    codes[:, :distinct_bytes] = rng.integers(0, 256, (count, distinct_bytes))
    return codes


def distances_oracle(a, b):
    return np.bitwise_count(a[:, None] ^ b[None]).sum(axis=-1, dtype=np.int64)


def matches_oracle(a, b, max_distance):
    if not len(a) or not len(b):
        return np.empty((0, 2), int), np.empty(0, int)
    distances = distances_oracle(a, b)
    column_of, row_of = distances.argmin(axis=1), distances.argmin(axis=0)
    rows = np.arange(len(a))
    keep = (row_of[column_of] == rows) & (distances[rows, column_of] <= max_distance)
    return np.stack((rows, column_of), axis=1)[keep], distances[rows, column_of][keep]


@given(st.integers(0, 40), st.integers(0, 40), st.sampled_from([1, 2, 32]), st.integers(0, 256), st.integers(0, 99))
def test_matches_are_those_of_brute_force_ties_included(count_a, count_b, distinct_bytes, max_distance, seed):
    rng = np.random.default_rng(seed)
    a, b = random_codes(rng, count_a, distinct_bytes), random_codes(rng, count_b, distinct_bytes)
    matches = mutual_matches(a, b, max_distance)
    pairs, distances = matches_oracle(a, b, max_distance)
    np.testing.assert_array_equal(matches.pairs, pairs)
    np.testing.assert_array_equal(matches.distances, distances)
    assert matches.pairs.shape == (len(pairs), 2)
    np.testing.assert_array_equal(hamming_matrix(a, b), distances_oracle(a, b).reshape(count_a, count_b))


def test_unaligned_and_strided_codes_are_read_rightly():
    rng = np.random.default_rng(6)
    codes = random_codes(rng, 10)
    unaligned = np.frombuffer(b"\0" + codes.tobytes(), np.uint8, offset=1).reshape(10, 32)
    np.testing.assert_array_equal(hamming_matrix(unaligned, codes), distances_oracle(codes, codes))
    np.testing.assert_array_equal(hamming_matrix(codes[::2], codes), distances_oracle(codes[::2], codes))


def test_the_input_stays_writeable():
    codes = random_codes(np.random.default_rng(7), 3)
    code_words(codes)
    assert codes.flags.writeable


@pytest.mark.parametrize("shape", [(3, 31), (32,), (2, 32, 1)])
def test_other_shapes_are_refused(shape):
    with pytest.raises(ValueError, match="32"):
        mutual_matches(np.zeros(shape, np.uint8), np.zeros((1, 32), np.uint8))


def test_other_types_are_refused():
    with pytest.raises(ValueError, match="float64"):
        mutual_matches(np.zeros((2, 32)), np.zeros((2, 32), np.uint8))
