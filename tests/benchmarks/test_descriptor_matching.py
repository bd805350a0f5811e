"""Nearest neighbours of both kinds of descriptors against the plainest loops."""

import numpy as np
import pytest
from evaluation.matching import mutual_pairs, nearest_neighbours

from fcslam.features.codes import mutual_matches


def sets(kind):
    rng = np.random.default_rng(5)
    if kind is np.uint8:
        return rng.integers(0, 256, (30, 32), np.uint8), rng.integers(0, 256, (45, 32), np.uint8)
    return rng.normal(size=(30, 16)).astype(np.float32), rng.normal(size=(45, 16)).astype(np.float32)


def distance(a, b):
    return np.unpackbits(a ^ b).sum() if a.dtype == np.uint8 else np.linalg.norm(a - b)


@pytest.mark.parametrize("kind", [np.uint8, np.float32])
def test_neighbours_are_those_of_the_loops(kind):
    a, b = sets(kind)
    to_b, to_a = nearest_neighbours(a, b)
    assert to_b.tolist() == [min(range(len(b)), key=lambda j: distance(row, b[j])) for row in a]
    assert to_a.tolist() == [min(range(len(a)), key=lambda i: distance(a[i], row)) for row in b]
    pairs = mutual_pairs(to_b, to_a)
    assert pairs.tolist() == [[i, j] for i, j in enumerate(to_b) if to_a[j] == i]
    assert 0 < len(pairs) < len(a)


def test_codes_match_as_those_of_places_do():
    a, b = sets(np.uint8)
    assert np.array_equal(mutual_pairs(*nearest_neighbours(a, b)), mutual_matches(a, b).pairs)
