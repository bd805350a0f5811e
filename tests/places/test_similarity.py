import numpy as np
import pytest
from evaluation.place_features import bag_of_words
from hypothesis import given
from hypothesis import strategies as st

from fcslam.places.similarity import PAPER_SCALE, paper_similarity, similarity

IDF = np.linspace(0.5, 3.0, 12)
word_lists = st.lists(st.integers(0, 11), max_size=30).map(lambda words: np.array(words, dtype=np.int64))


def dense(bag):
    vector = np.zeros(len(IDF))
    vector[bag.words] = bag.values
    return vector


@given(word_lists, word_lists)
def test_the_papers_formula_is_exactly_four_times_the_l1_score(words_x, words_y):
    x, y = bag_of_words(words_x, IDF, 1), bag_of_words(words_y, IDF, 1)
    assert paper_similarity(x, y) == pytest.approx(PAPER_SCALE * similarity(x, y), abs=1e-12)
    assert similarity(x, y) == pytest.approx(similarity(y, x), abs=1e-12)
    assert 0.0 <= similarity(x, y) <= 1.0 + 1e-12


@given(word_lists, word_lists)
def test_both_agree_with_the_formula_over_all_words(words_x, words_y):
    x, y = bag_of_words(words_x, IDF, 1), bag_of_words(words_y, IDF, 1)
    Zx, Zy = dense(x), dense(y)
    assert paper_similarity(x, y) == pytest.approx(2.0 * sum(abs(Zx) + abs(Zy) - abs(Zx - Zy)), abs=1e-12)
    if len(words_x) and len(words_y):
        assert similarity(x, y) == pytest.approx(1.0 - 0.5 * abs(Zx - Zy).sum(), abs=1e-12)


def test_values_are_tf_idf_over_their_sum():
    bag = bag_of_words(np.array([2, 5, 2]), np.array([1.0, 1.0, 0.5, 1.0, 1.0, 3.0]), 1)
    np.testing.assert_array_equal(bag.words, [2, 5])
    np.testing.assert_allclose(bag.values, [0.25, 0.75])


def test_words_that_tell_nothing_are_left_out():
    bag = bag_of_words(np.array([0, 1]), np.array([0.0, 0.0]), 1)
    assert len(bag.words) == 0
    assert similarity(bag, bag) == 0.0


def test_versions_do_not_mix():
    with pytest.raises(ValueError, match="1 and 2"):
        similarity(bag_of_words(np.array([1]), IDF, 1), bag_of_words(np.array([1]), IDF, 2))
