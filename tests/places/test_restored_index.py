"""A restored index goes on as the original would have."""

import numpy as np
import pytest

from fcslam.places.index import PlaceIndex
from fcslam.places.vocabulary import Scoring, Strategy, TreeConfig, VocabularyConfig
from fcslam.records import KeyscanId

COUNT = 40


def places(seed=0):
    rng = np.random.default_rng(seed)
    centres = rng.integers(0, 256, (30, 32), dtype=np.uint8)
    flips = np.packbits(rng.random((2 * COUNT, 40, 256)) < 0.03, axis=2)
    return list(centres[rng.integers(0, 30, (2 * COUNT, 40))] ^ flips)


def filled(config):
    index = PlaceIndex[KeyscanId](config, np.random.default_rng(2))
    for number, place in enumerate(places()[:COUNT]):
        index.add(KeyscanId("a", number), place)
    for number in range(0, 30, 2):
        index.forget(KeyscanId("a", number))
    return index


@pytest.mark.slow
@pytest.mark.parametrize("strategy", list(Strategy))
@pytest.mark.parametrize("scoring", list(Scoring))
def test_a_restored_index_goes_on_as_the_original(strategy, scoring):
    tree = TreeConfig(branching=4)
    config = VocabularyConfig(strategy=strategy, scoring=scoring, train_batch=4, leaf_capacity=16, tree=tree)
    index = filled(config)
    kept = [number for number in range(COUNT) if number % 2 or number >= 30]
    ids, descriptors = [KeyscanId("a", number) for number in kept], [places()[number] for number in kept]
    other = PlaceIndex.restored(config, index.state(), ids, descriptors)
    for step, place in enumerate(places()[COUNT:]):
        assert (len(other), other.word_count, other.version) == (len(index), index.word_count, index.version)
        assert other.trained_on == index.trained_on
        found, expected = other.query(place, 100), index.query(place, 100)
        assert [s for _, s in found] == pytest.approx([s for _, s in expected], abs=1e-9)
        assert dict(found) == pytest.approx(dict(expected), abs=1e-9)
        assert other.bag(place).words.tolist() == index.bag(place).words.tolist()
        for each in (index, other):
            each.add(KeyscanId("b", step), place)
            if step % 3 == 0:
                each.forget(KeyscanId("b", step // 2))


def test_an_index_that_was_never_trained():
    empty = PlaceIndex[int](VocabularyConfig(), np.random.default_rng(0))
    assert len(PlaceIndex[int].restored(VocabularyConfig(), empty.state(), [], [])) == 0
