"""The paper's figure 4 on drawn places, its measures against plain loops."""

import numpy as np
import pytest
from evaluation.place_features import choose_features, describe_sets
from evaluation.vocabulary_growth import (
    BATCH,
    MEASURES,
    draw_groups,
    group_measures,
    grow_vocabulary,
)

from fcslam.places.vocabulary import Strategy, VocabularyConfig
from tests.benchmarks import place_folders

pytestmark = pytest.mark.slow

GROUPS, SEED = 12, 3


@pytest.fixture(scope="module")
def tour(tmp_path_factory):
    return place_folders.tour(tmp_path_factory.mktemp("growth") / "tour", images=90, first_again=60)


@pytest.fixture(scope="module")
def world(tour):
    return draw_groups(describe_sets([tour], (), choose_features("orb")), GROUPS, np.random.default_rng(SEED))


def test_measures_are_those_of_each_group():
    similarities = np.random.default_rng(0).uniform(0, 1, (30, 9)).round(1)
    similarities[0], similarities[1, 0] = 0.0, 0.0
    measured = group_measures(similarities)
    for g, (true, *wrong) in enumerate(similarities.tolist()):
        ahead = true - max(wrong)
        relative = max(-1.0, ahead / true) if true else -1.0
        mean = sum(wrong) / 8
        expected = (ahead, relative, float(ahead <= 0), mean, sum((x - mean) ** 2 for x in wrong) / 8)
        assert [measured[name][g] for name in MEASURES] == pytest.approx(list(expected))


def test_targets_never_arrive_and_members_are_what_the_truth_says(world):
    groups, arrivals = world
    assert (len(groups), len(arrivals)) == (GROUPS, 90 - GROUPS)
    stored = {place.name: place.descriptors for place in arrivals}
    for group in groups:
        assert not any(np.array_equal(group.target, codes) for codes in stored.values())
        match, *wrong = (int(name.split("/")[-1][:3]) - 1 for name in group.names)
        assert len(set(wrong)) == 8
        query = match + 60
        pairs = [(k + 60, k) for k in range(30)]
        assert not any(abs(query - j) <= 8 and abs(place - i) <= 8 for place in wrong for j, i in pairs)


@pytest.mark.parametrize("strategy", list(Strategy))
def test_each_strategy_is_asked_in_its_own_words(world, strategy):
    groups, arrivals = world
    config = VocabularyConfig()
    growth = grow_vocabulary(strategy, arrivals, groups, config, SEED)
    updates = len(arrivals) // BATCH
    assert growth.similarities.shape == (updates, GROUPS, 9)
    assert growth.places.tolist() == [BATCH * (k + 1) for k in range(updates)]
    assert ((growth.similarities >= 0.0) & (growth.similarities <= 1.0)).all()
    assert (growth.words > 1).all()
    assert (growth.seconds > 0.0).all()
    assert growth.intervals(-1, SEED)["mismatch rate"].mean < 0.5  # drawn places differ clearly
