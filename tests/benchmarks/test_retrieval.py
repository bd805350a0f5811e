"""Retrieval measures against plain loops over every order of equals and every threshold, and their laws."""

from itertools import pairwise, permutations

import numpy as np
import pytest
from evaluation.retrieval import (
    PairTruth,
    excluding_recent,
    mismatches,
    multi_match_curve,
    recall_at,
    relative_significance,
    significance,
    single_best,
)
from hypothesis import given
from hypothesis import strategies as st

MATCH, DIFFERENT, IGNORED = 1, -1, 0


@st.composite
def questions(draw, most_queries=4, most_places=6):
    """Similarities with many ties, zeros among them, and what is known of each pair."""
    queries, places = draw(st.integers(1, most_queries)), draw(st.integers(1, most_places))
    cells = queries * places
    similarity = draw(st.lists(st.integers(0, 3), min_size=cells, max_size=cells))
    known = draw(st.lists(st.sampled_from((MATCH, DIFFERENT, IGNORED)), min_size=cells, max_size=cells))
    relation = np.array(known).reshape(queries, places)
    truth = PairTruth(relation == MATCH, relation == DIFFERENT)
    return np.array(similarity, float).reshape(queries, places), truth


def orders(row, truth, query):
    """Every order of the candidates of a query that its similarities allow, retrieved ones only."""
    known = np.flatnonzero((truth.matches | truth.different)[query] & (row > 0))
    return [order for order in permutations(known) if all(row[a] >= row[b] for a, b in pairwise(order))]


@given(questions(), st.integers(1, 4))
def test_recall_is_the_mean_over_all_orders_of_equals(question, k):
    similarity, truth = question
    expected = [
        np.mean([any(truth.matches[q, place] for place in order[:k]) for order in orders(similarity[q], truth, q)])
        for q in range(len(similarity))
        if truth.matches[q].any()
    ]
    np.testing.assert_allclose(recall_at(similarity, truth, k), expected)


@given(questions())
def test_single_best_answers_are_the_mean_over_all_orders_of_equals(question):
    similarity, truth = question
    answers = single_best(similarity, truth)
    for q, row in enumerate(similarity):
        firsts = [order[0] for order in orders(row, truth, q) if order]
        assert answers.scores[q] == (row[firsts[0]] if firsts else 0.0)
        assert answers.right[q] == pytest.approx(
            np.mean([truth.matches[q, first] for first in firsts]) if firsts else 0.0
        )


def area_by_loops(answers, to_find):
    """Average precision and the largest recall at full precision, from (score, right) pairs."""
    area, before, full = 0.0, 0.0, 0.0
    for threshold in sorted({score for score, _ in answers}, reverse=True):
        said = [right for score, right in answers if score >= threshold]
        precision, recall = sum(said) / len(said), sum(said) / to_find
        area += (recall - before) * precision
        before = recall
        full = recall if precision == 1.0 else full
    return area, full


@given(questions())
def test_curves_are_those_of_every_threshold(question):
    similarity, truth = question
    best = single_best(similarity, truth)
    single = [(score, right) for score, right in zip(best.scores, best.right, strict=True) if score > 0]
    known = (truth.matches | truth.different) & (similarity > 0)
    multi = [(similarity[at], float(truth.matches[at])) for at in zip(*np.nonzero(known), strict=True)]
    for curve, answers, to_find in (
        (best.curve(), single, int(truth.answerable.sum())),
        (multi_match_curve(similarity, truth), multi, int(truth.matches.sum())),
    ):
        if not to_find:
            assert not answers or np.isnan(curve.average_precision)
            continue
        area, full = area_by_loops(answers, to_find)
        assert curve.average_precision == pytest.approx(area)
        assert curve.recall_at_full_precision == pytest.approx(full)


@given(questions())
def test_a_mismatch_is_no_match_ahead_of_every_wrong_place(question):
    similarity, truth = question
    rows = [q for q in range(len(similarity)) if truth.matches[q].any()]
    right = [max(similarity[q][truth.matches[q]]) for q in rows]
    wrong = [max([0.0, *similarity[q][truth.different[q]]]) for q in rows]
    ahead = [a - b for a, b in zip(right, wrong, strict=True)]
    np.testing.assert_allclose(significance(similarity, truth), ahead)
    np.testing.assert_allclose(mismatches(similarity, truth), [float(value <= 0.0) for value in ahead])
    relative = [max(-1.0, value / of) if of else -1.0 for value, of in zip(ahead, right, strict=True)]
    np.testing.assert_allclose(relative_significance(similarity, truth), relative)


@given(questions(), st.randoms(use_true_random=False))
def test_ignored_pairs_and_the_scale_count_for_nothing(question, random):
    similarity, truth = question
    changed = np.where(truth.matches | truth.different, similarity**3, random.random() * 100.0)
    np.testing.assert_array_equal(recall_at(similarity, truth, 2), recall_at(changed, truth, 2))
    np.testing.assert_allclose(
        single_best(similarity, truth).curve().recall, single_best(changed, truth).curve().recall
    )
    np.testing.assert_array_equal(mismatches(similarity, truth), mismatches(changed, truth))


@given(st.lists(st.integers(0, 5), min_size=1, max_size=20), st.integers(0, 12))
def test_only_places_from_long_before_may_answer(steps, gap):
    stamps = np.cumsum(steps)
    admitted = excluding_recent(stamps, gap)
    for t, j in np.ndindex(admitted.shape):
        assert admitted[t, j] == (j < t and stamps[t] - stamps[j] >= gap)
