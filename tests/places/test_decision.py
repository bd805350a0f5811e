"""Algorithm 1 to the letter: words alone decide. The oracle is the paper's formulas in plain loops."""

import math
from collections import Counter
from functools import cache

import numpy as np
import pytest

from fcslam.config import load
from fcslam.lab.presets import Preset
from fcslam.mission.mission import MissionConfig
from fcslam.places.index import PlaceIndex
from fcslam.places.matcher import PlaceMatcher
from fcslam.places.vocabulary import Strategy
from fcslam.records import Channel, KeyscanId, Place, ReasonCode, frozen
from tests.places.test_vocabulary import walk

pytestmark = pytest.mark.slow

PRESET = load(MissionConfig, Preset.PAPER.file).fleet.matcher
EVERY_PLACE = PRESET.vocabulary.model_copy(update={"strategy": Strategy.REBUILD})
PAPER = PRESET.model_copy(update={"vocabulary": EVERY_PLACE})
PLACES = 26
L = PAPER.vocabulary.train_batch


def scenes(seed):
    """Descriptors (N, 32) of places that robots a and b take turns to send; many share a scene."""
    rng = np.random.default_rng(seed)
    centres = rng.integers(0, 256, (60, 32), dtype=np.uint8)
    seen = [centres[rng.choice(60, 12, replace=False)] for _ in range(5)]
    noise = [np.packbits(rng.random((60, 256)) < 0.04, axis=1) for _ in range(PLACES)]
    return [np.repeat(seen[rng.integers(5)], 5, axis=0) ^ bits for bits in noise]


def place(number, codes):
    keypoints = frozen(np.zeros((len(codes), 2)), np.float32)
    return Place(
        KeyscanId("ab"[number % 2], number), Channel.CAMERA, "v", number, number, keypoints, frozen(codes, np.uint8)
    )


def bag(words, documents, places):
    """Z_k: tf-idf of each word, divided by the sum."""
    z = {word: count * math.log(places / max(documents[word], 1)) for word, count in Counter(words).items()}
    total = sum(z.values())
    return {word: value / total for word, value in z.items()} if total else {}


def eq_4(x, y):
    return 2 * sum(x.get(w, 0.0) + y.get(w, 0.0) - abs(x.get(w, 0.0) - y.get(w, 0.0)) for w in {*x, *y})


@cache
def similarities():
    """{(i, j): Sim} of all pairs of two robots; the k-means trees are those of the index."""
    index, found, all_codes = PlaceIndex[int](PAPER.vocabulary, np.random.default_rng(0)), {}, scenes(seed=1)
    for j, codes in enumerate(all_codes):
        if index.trained_on is not None:
            tree = index.vocabulary.tree
            words = [[walk(tree, code) for code in others.view(np.uint64)] for others in all_codes[:j]]
            documents = Counter(word for of_place in words for word in set(of_place))
            query = bag([walk(tree, code) for code in codes.view(np.uint64)], documents, j)
            for i in range(1 - j % 2, j, 2):
                found[i, j] = eq_4(query, bag(words[i], documents, j))
        index.add(j, codes)
    return found


@pytest.mark.parametrize("delta", [0.3, 0.85, 2.0])
def test_the_words_decide_as_in_algorithm_1(delta):
    matcher = PlaceMatcher(PAPER.model_copy(update={"delta": delta}), no_submap, np.random.default_rng(0))
    found = {}
    for j, codes in enumerate(scenes(seed=1)):
        for match in matcher.match(place(j, codes), {}, lambda i, j=j: i.robot != "ab"[j % 2]):
            found[match.i.number, match.j.number] = match
    expected = {pair: sim for pair, sim in similarities().items() if sim >= delta}
    assert found.keys() == expected.keys()
    assert [4 * match.similarity for match in found.values()] == pytest.approx([expected[pair] for pair in found])
    assert all(match.M and match.reason.code is ReasonCode.SIMILAR for match in found.values())
    assert min(j for _, j in found) > L, "before the first vocabulary nothing is compared"
    assert 0 < len(expected) < len(similarities())


def no_submap(place):
    raise AssertionError("geometry has no say")
