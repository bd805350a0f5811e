"""Forgetting by area: bounded however long a robot drives, and nobody else's places go."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fcslam.places.thinning import crowded_out

ways = st.lists(st.tuples(st.integers(-3, 3), st.integers(-3, 3)), max_size=60)


@given(ways, st.integers(1, 4), st.sampled_from([0.0, 1.0, 2.0, 3.5]))
def test_no_disc_of_half_the_radius_ever_holds_more(way, most, radius_m):
    kept = []
    for place in enumerate(way):
        kept.append(place)
        positions = np.array([position for _, position in kept], float)
        near = [k for k, p in enumerate(positions) if np.hypot(*(p - positions[-1])) <= radius_m]
        gone = crowded_out(positions, radius_m, most).tolist()
        assert gone == near[: max(len(near) - most, 0)]
        assert len(kept) - 1 not in gone, "the newest stays"
        kept = [each for k, each in enumerate(kept) if k not in gone]
        positions = np.array([position for _, position in kept], float)
        for centre in positions:
            assert (np.hypot(*(positions - centre).T) <= radius_m / 2).sum() <= most


def test_a_robot_that_drives_its_rounds_for_ever_keeps_the_newest():
    kept = []
    for k in range(1000):
        kept.append((k, (10.0 * np.cos(0.1 * k), 10.0 * np.sin(0.1 * k))))
        gone = crowded_out(np.array([position for _, position in kept]), 2.0, 6)
        kept = [each for row, each in enumerate(kept) if row not in gone]
    assert len(kept) <= 6 * 63
    assert len(kept) < 200
    assert min(k for k, _ in kept) > 800


@pytest.mark.parametrize("count", [0, 1, 3])
def test_few_places_are_never_too_many(count):
    assert not len(crowded_out(np.zeros((count, 2)), 5.0, 3))
