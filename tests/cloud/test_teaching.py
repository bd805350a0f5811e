"""Other robots' codes teach a robot about the points of one place, and about no other points."""

import numpy as np
import pytest

from fcslam.cloud.teaching import FARTHEST_BITS, PlacePoints, teach

POINTS = 60
RNG = np.random.default_rng(3)
POSITIONS = RNG.uniform([0, -2, 0], [4, 2, 2], (POINTS, 3))
OWN = RNG.integers(0, 2, (POINTS, 256)).astype(np.uint8)


def flipped(bits, count, seed):
    """The bits (N, 256) with ``count`` of each row flipped."""
    rng = np.random.default_rng(seed)
    other = bits.copy()
    for row in other:
        row[rng.permutation(256)[:count]] ^= 1
    return other


def place(bits, shift=(0.0, 0.0, 0.0), order=None):
    rows = np.arange(POINTS) if order is None else order
    return PlacePoints((POSITIONS + shift)[rows], np.packbits(bits, axis=1)[rows])


OTHERS = flipped(OWN, 40, 4)
"""How robots in another light describe the points."""


def other_place(seed, shift=(0.0, 0.0, 0.0)):
    return place(flipped(OTHERS, 8, seed), shift, np.random.default_rng(seed).permutation(POINTS))


def test_places_that_agree_teach_their_code():
    taught = teach(place(OWN), [other_place(1), other_place(2), other_place(3)])
    assert len(taught.rows) > 0.9 * POINTS
    bits = np.unpackbits(taught.codes, axis=1)
    to_others = np.sum(bits != OTHERS[taught.rows], axis=1)
    to_own = np.sum(bits != OWN[taught.rows], axis=1)
    assert to_others.max() <= 8
    assert to_own.min() >= 30
    assert set(taught.places) <= {2, 3}
    assert taught.size_bytes == 6 + 34 * len(taught.rows)


def test_positions_that_are_off_together_are_corrected():
    exact = teach(place(OWN), [other_place(1), other_place(2)])
    off = teach(place(OWN), [other_place(1, (0.05, 0.04, 0.0)), other_place(2, (-0.06, 0.0, 0.02))])
    assert np.array_equal(exact.rows, off.rows)
    assert np.array_equal(exact.codes, off.codes)


def test_one_place_teaches_nothing():
    taught = teach(place(OWN), [other_place(1)])
    assert len(taught.rows) == 0
    assert taught.size_bytes == 0
    assert taught.codes.shape == (0, 32)


@pytest.mark.parametrize("liars", [1, 2])
def test_codes_that_few_places_made_up_do_not_count(liars):
    """The liars use the robot's own code for some points, so that they count, and any code for others."""
    lie = OWN.copy()
    lie[20:] = np.random.default_rng(9).integers(0, 2, (POINTS - 20, 256))
    honest = [other_place(seed) for seed in range(1, 4)]
    taught = teach(place(OWN), [*honest, *[place(lie)] * liars])
    assert len(taught.rows) > 0.9 * POINTS
    assert np.sum(np.unpackbits(taught.codes, axis=1) != OTHERS[taught.rows], axis=1)[taught.rows >= 20].max() <= 40


def test_two_camps_teach_nothing_and_neither_does_a_code_unlike_the_robots_own():
    lie = OWN.copy()
    lie[20:] = np.random.default_rng(9).integers(0, 2, (POINTS - 20, 256))
    assert np.all(teach(place(OWN), [place(lie), place(lie), other_place(1), other_place(2)]).rows < 20)
    alone = teach(place(OWN), [place(lie), place(lie)])
    assert np.all(alone.rows < 20)
    assert np.sum(lie[20:] != OWN[20:], axis=1).min() > FARTHEST_BITS


def test_a_place_without_keypoints_teaches_nothing_and_learns_nothing():
    empty = PlacePoints(np.zeros((0, 3)), np.zeros((0, 32), np.uint8))
    assert len(teach(place(OWN), [empty, empty]).rows) == 0
    assert len(teach(empty, [other_place(1), other_place(2)]).rows) == 0
