"""Forgetting by area: bounded however long a robot drives, and no area is forgotten."""

from collections import defaultdict

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fcslam.geometry.thinning import places_of_old_sessions, surplus_places

coordinates = st.floats(-4.0, 4.0)
ways = st.lists(st.tuples(coordinates, coordinates), max_size=60)


def square(xy, side_m):
    return tuple(np.floor(np.array(xy) / side_m + 0.5).tolist())


def driven(way, side_m, most):
    """Numbers of the places that are kept at the end of the way."""
    kept = []
    for number in range(len(way)):
        kept.append(number)
        gone = surplus_places(np.array([way[k] for k in kept], float), side_m, most).tolist()
        kept = [k for row, k in enumerate(kept) if row not in gone]
    return kept


@given(ways, st.integers(1, 4), st.sampled_from([0.7, 1.0, 2.0, 20.0]))
def test_every_square_keeps_its_newest_and_never_more(way, most, side_m):
    squares = defaultdict(list)
    for number, xy in enumerate(way):
        squares[square(xy, side_m)].append(number)
    assert driven(way, side_m, most) == sorted(k for numbers in squares.values() for k in numbers[-most:])


@pytest.mark.parametrize("count", [0, 1, 3])
def test_few_places_are_never_too_many(count):
    assert not len(surplus_places(np.zeros((count, 2)), 5.0, 3))


def test_a_square_keeps_the_places_of_its_newest_sessions():
    positions = np.array([(0, 0), (10, 0), (0, 0), (0, 1), (0, 0), (0, 1)], float)
    sessions = ["a", "a", "a+1", "a+1", "a+2", "a+2"]
    assert places_of_old_sessions(positions, sessions, 5.0, 2).tolist() == [0]
    assert places_of_old_sessions(positions, sessions, 5.0, 1).tolist() == [0, 2, 3]
    assert not len(places_of_old_sessions(positions, sessions, 5.0, 3))
    assert not len(places_of_old_sessions(positions[:2], sessions[:2], 5.0, 1)), "a session never forgets itself"
