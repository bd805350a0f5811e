"""The scorers against plain comparison, pair by pair."""

import numpy as np
import pytest
from evaluation.place_features import (
    ACCEPTED_INLIERS,
    PairVerifier,
    PretrainedVocabulary,
    brute_force,
    choose_features,
    describe_images,
    describe_sets,
    strategy_scorer,
)
from evaluation.place_sets import read_place_set
from evaluation.places import differences
from evaluation.retrieval import PairTruth, recall_at, single_best

from fcslam.cli import main
from fcslam.features.codes import hamming_matrix
from fcslam.places.index import PlaceIndex
from fcslam.places.similarity import similarity
from fcslam.places.vocabulary import Scoring, VocabularyConfig
from tests.benchmarks import place_folders

WORDS = VocabularyConfig(scoring=Scoring.WORDS, train_batch=3)


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    folder = tmp_path_factory.mktemp("sets")
    return place_folders.generic(folder / "generic"), place_folders.tour(folder / "tour")


@pytest.fixture(scope="module")
def described(folders):
    return describe_sets(folders, (), choose_features("orb"))


def test_brute_force_counts_mutual_neighbours(described):
    split, _ = described
    scores = brute_force(split)
    for q, g in ((0, 0), (0, 1), (3, 3), (4, 5)):
        distances = hamming_matrix(split.queries[q].descriptors, split.gallery[g].descriptors)
        mutual = [
            (i, j)
            for i, j in enumerate(distances.argmin(axis=1))
            if distances[:, j].argmin() == i and distances[i, j] <= 48
        ]
        assert scores[q, g] == len(mutual)
    assert (scores.argmax(axis=1) == np.arange(5)).all()


def test_the_foreign_tree_scores_as_the_bags_of_two_places(described):
    split, tour = described
    tree = PretrainedVocabulary([place.descriptors for place in tour.gallery], 1)
    assert tree.word_count > 100
    scores = tree(split)
    for (q, g), score in np.ndenumerate(scores):
        bags = tree.bag(split.queries[q].descriptors), tree.bag(split.gallery[g].descriptors)
        assert score == pytest.approx(similarity(*bags))


def test_a_stream_is_asked_before_each_place_is_added(described):
    _, tour = described
    scores = strategy_scorer(WORDS, 1)(tour)
    assert (scores[~tour.place_set.admitted] == 0.0).all()
    index = PlaceIndex(WORDS, np.random.default_rng(1))
    for g in range(31):
        index.add(g, tour.gallery[g].descriptors)
    answers = dict(index.query(tour.queries[31].descriptors, 100))
    np.testing.assert_allclose(scores[31, :12], [answers.get(g, 0.0) for g in range(12)])


def test_geometry_accepts_what_it_should(described):
    split, _ = described
    checker = PairVerifier(split)
    verified = checker.verified(brute_force(split))
    same = np.eye(5, 6, dtype=bool)
    assert (verified[same] >= 0.5).all()
    assert (verified[~same] < 0.5).all()
    inliers = checker.inliers(2, 2)
    assert verified[2, 2] == inliers / (inliers + ACCEPTED_INLIERS)
    assert (checker.verified(np.zeros((5, 6))) == 0.0).all()


def test_extracted_features_are_those_of_the_detector(folders, tmp_path):
    name = folders[0].name
    options = ["--detector", "orb", "--keypoints", "500"]
    assert main(["tools", "extract", str(folders[0]), "-o", str(tmp_path / name), *options]) == 0
    found = describe_images(read_place_set(folders[0]), folders[0], choose_features(str(tmp_path)))
    assert all(len(place.descriptors) for place in (*found.queries, *found.gallery))
    (truth,) = found.place_set.questions.values()
    assert recall_at(brute_force(found), truth, 1).tolist() == [1.0] * 5


def test_a_comparison_is_paired():
    rng = np.random.default_rng(1)
    same = np.repeat(np.eye(20, dtype=bool), 3, axis=0)
    truth = PairTruth(same, ~same)
    good, poor = (same * share + rng.uniform(0.0, 1.0, same.shape) for share in (1.0, 0.5))
    assert set(differences(poor, poor, truth, rng).values()) == {(0.0, 0.0, 0.0)}
    ahead, behind = (differences(*pair, truth, rng) for pair in ((good, poor), (poor, good)))
    for name, gain in ahead.items():
        assert gain.low <= gain.mean <= gain.high
        assert gain.mean == pytest.approx(-behind[name].mean)
    first, second = (single_best(each, truth) for each in (good, poor))
    assert ahead["average_precision"].mean == first.curve().average_precision - second.curve().average_precision
    assert ahead["recall_at_1"].mean == pytest.approx(
        recall_at(good, truth, 1).mean() - recall_at(poor, truth, 1).mean()
    )
    assert ahead["recall_at_1"].low > 0.0
