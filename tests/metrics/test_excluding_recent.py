"""Places that a robot passed a moment ago do not answer."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from fcslam.metrics.retrieval import excluding_recent
from fcslam.places.index import PlaceIndex
from fcslam.places.vocabulary import VocabularyConfig


@given(st.lists(st.integers(0, 5), min_size=1, max_size=20), st.integers(0, 12))
def test_only_places_from_long_before_may_answer(steps, gap):
    stamps = np.cumsum(steps)
    admitted = excluding_recent(stamps, gap)
    for t, j in np.ndindex(admitted.shape):
        assert admitted[t, j] == (j < t and stamps[t] - stamps[j] >= gap)


def test_a_robot_that_goes_on_finds_its_first_visit_and_not_its_last_steps():
    """Every place shares most of its descriptors with the one before: the most similar are the most recent."""
    rng = np.random.default_rng(0)
    hall = rng.integers(0, 256, (400, 32), dtype=np.uint8)
    way = [hall[10 * k : 10 * k + 60] for k in (*range(30), *range(20))]
    admitted = excluding_recent(np.arange(len(way)), 8)
    index = PlaceIndex[int](VocabularyConfig(train_batch=3), rng)
    answers = []
    for t, place in enumerate(way):
        recent = set(np.flatnonzero(~admitted[t]).tolist())
        answers.append(([f.id for f in index.query(place, 1)], [f.id for f in index.query(place, 1, recent)]))
        index.add(t, place)
    assert all(bare == [t - 1] for t, (bare, _) in enumerate(answers[5:30], 5))
    assert [kept for _, kept in answers[30:]] == [[k] for k in range(20)]
    assert all(not kept or kept[0] <= t - 8 for t, (_, kept) in enumerate(answers))
