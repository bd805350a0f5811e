"""Streams of places: recent ones left out, shares of what neighbours give, runs of matches; against plain loops."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import array_shapes, arrays

from fcslam.places.index import PlaceIndex
from fcslam.places.sequence import excluding_recent, normalised_by_previous, sequence_similarity, temporally_consistent
from fcslam.places.vocabulary import VocabularyConfig

similarities = arrays(
    np.float64,
    array_shapes(min_dims=2, max_dims=2, min_side=1, max_side=12),
    elements=st.sampled_from([0.0, 0.1, 0.4, 0.5, 1.0]),
)


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


@given(similarities, st.floats(0.01, 1.0), st.floats(0.01, 50.0))
def test_shares_do_not_depend_on_the_scale_of_a_query(similarity, to_previous, scale):
    previous = np.full(len(similarity), to_previous)
    shares = normalised_by_previous(similarity, previous)
    np.testing.assert_allclose(shares * to_previous, similarity, atol=1e-12)
    np.testing.assert_allclose(normalised_by_previous(scale * similarity, scale * previous, 0.0), shares)
    np.testing.assert_array_equal(
        np.argsort(-shares, axis=1, kind="stable"), np.argsort(-similarity, axis=1, kind="stable")
    )


@pytest.mark.parametrize("to_previous", [0.0, 0.004, 1e-310])
def test_a_query_unlike_the_place_before_it_retrieves_nothing(to_previous):
    shares = normalised_by_previous(np.ones((2, 3)), np.array([to_previous, 0.5]))
    assert shares.tolist() == [[0.0] * 3, [2.0] * 3]
    assert np.isfinite(normalised_by_previous(np.ones((1, 3)), np.array([to_previous]), least=0.0)).all()


def runs_oracle(similarity, hits, reach):
    """Whether some chain of matches of the queries before leads to the pair, link by link."""

    def leads(t, j, length):
        if length == 1:
            return True
        if t == 0:
            return False
        row = similarity[t - 1]
        return any(
            row[k] == row.max() and row[k] > 0.0 and leads(t - 1, k, length - 1)
            for k in range(max(0, j - reach), min(len(row), j + reach + 1))
        )

    return np.array([[s if leads(t, j, hits) else 0.0 for j, s in enumerate(row)] for t, row in enumerate(similarity)])


@settings(max_examples=60)
@given(similarities, st.integers(1, 4), st.integers(0, 2))
def test_what_is_kept_ends_a_chain_of_matches(similarity, hits, reach):
    np.testing.assert_array_equal(temporally_consistent(similarity, hits, reach), runs_oracle(similarity, hits, reach))


@given(similarities, st.integers(1, 4), st.integers(0, 3))
def test_more_hits_keep_less_and_more_reach_keeps_more(similarity, hits, reach):
    kept = temporally_consistent(similarity, hits, reach)
    np.testing.assert_array_equal(temporally_consistent(similarity, 1, reach), similarity)
    assert (temporally_consistent(similarity, hits + 1, reach) <= kept).all()
    assert (temporally_consistent(similarity, hits, reach + 1) >= kept).all()


def mean_oracle(similarity, places, reach):
    """Term by term."""

    def term(t, j):
        if t < 0:
            return 0.0
        return max((similarity[t, k] for k in range(similarity.shape[1]) if abs(k - j) <= reach), default=0.0)

    result = np.zeros(similarity.shape)
    for t, j in np.argwhere(similarity > 0.0):
        sums = [similarity[t, j] + sum(term(t - k, j - way * k) for k in range(1, places)) for way in (1, -1)]
        result[t, j] = max(sums) / places
    return result


@settings(max_examples=60)
@given(similarities, st.integers(1, 15), st.integers(0, 3))
def test_the_mean_along_the_way_is_that_of_its_terms(similarity, places, reach):
    mean = sequence_similarity(similarity, places, reach)
    np.testing.assert_allclose(mean, mean_oracle(similarity, places, reach), atol=1e-12)
    np.testing.assert_array_equal(sequence_similarity(similarity, 1, reach), similarity)
    assert (sequence_similarity(similarity, places, reach + 1) >= mean).all()
    np.testing.assert_allclose(sequence_similarity(3.0 * similarity, places, reach), 3.0 * mean)


@pytest.mark.slow
@given(similarities, st.integers(1, 4), st.integers(0, 3))
def test_a_way_driven_back_counts_as_one_driven_again(similarity, length, reach):
    for way in (temporally_consistent, sequence_similarity):
        np.testing.assert_array_equal(way(similarity[:, ::-1], length, reach)[:, ::-1], way(similarity, length, reach))


@pytest.mark.parametrize("backwards", [False, True])
def test_an_alias_more_similar_than_the_true_place_loses_along_the_way(backwards):
    similarity = np.full((6, 40), 0.1)
    for t in range(6):
        similarity[t, 20 - t if backwards else 20 + t] = 0.5
    similarity[4, 3] = 0.8
    assert similarity[4].argmax() == 3
    assert sequence_similarity(similarity, 3, 1)[4].argmax() == (16 if backwards else 24)


def test_a_single_alias_between_places_that_match_elsewhere_is_dropped():
    similarity = np.zeros((6, 40))
    for t, j in enumerate((3, 4, 5, 30, 7, 8)):
        similarity[t, j] = 0.5
    similarity[3, 6] = 0.4
    kept = temporally_consistent(similarity, hits=3, reach=1)
    assert [(int(t), int(j)) for t, j in np.argwhere(kept)] == [(2, 5), (3, 6)]


@pytest.mark.parametrize("shape", [(0, 0), (0, 4), (3, 0)])
def test_nothing_gives_nothing(shape):
    assert (
        temporally_consistent(np.zeros(shape), 3, 2).shape == sequence_similarity(np.zeros(shape), 3, 2).shape == shape
    )
    assert normalised_by_previous(np.zeros(shape), np.zeros(shape[0])).shape == shape
    assert excluding_recent(np.zeros(0), 1.0).shape == (0, 0)
