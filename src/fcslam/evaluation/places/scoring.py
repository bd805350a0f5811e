"""What is compared on places: the fleet's own index in each of its strategies, and what it has to be better than.

Each gives similarities (Q, G) of queries and gallery, 0 where a place is not retrieved or not admitted.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numba import njit
from numpy.typing import NDArray

from fcslam.evaluation.places.sets import PlaceSet
from fcslam.features.codes import code_words, mutual_matches
from fcslam.places.index import PlaceIndex
from fcslam.places.kmeans_tree import Tree, TreeShape, find_leaves, grow_tree
from fcslam.places.similarity import BagOfWords, bag_of_words
from fcslam.places.vocabulary import Strategy, VocabularyConfig
from fcslam.records import Codes, FloatArray

BRUTE_FORCE_BITS: Final = 48
BRUTE_FORCE, FOREIGN_TREE = "brute force", "foreign tree"
FOREIGN_SHAPE: Final = TreeShape(branching=10, depth=4, smallest_split=2, iterations=8)
"""As DBoW users have it."""


@dataclass(frozen=True, slots=True)
class PlaceFeatures:
    """What describes a place."""

    positions: NDArray[np.float32]
    """Shape (N, 2): pixels of an image, or metres in a submap."""
    descriptors: Codes
    """Shape (N, 32)."""


@dataclass(frozen=True, slots=True)
class DescribedSet:
    """A set of places and the features of each."""

    place_set: PlaceSet
    queries: Sequence[PlaceFeatures]
    gallery: Sequence[PlaceFeatures]
    count_inliers: Callable[[PlaceFeatures, PlaceFeatures], int]
    """Geometry: how many matches of two places one motion explains."""


Scorer = Callable[[DescribedSet], FloatArray]


def brute_force(described: DescribedSet) -> FloatArray:
    """How many descriptors of two places are each other's nearest, at most 48 bits apart."""
    scores = np.zeros(described.place_set.admitted.shape)
    for q, g in np.argwhere(described.place_set.admitted):
        scores[q, g] = matching_descriptors(described.queries[q].descriptors, described.gallery[g].descriptors)
    return scores


def matching_descriptors(a: Codes, b: Codes) -> float:
    """Brute force for two places."""
    return float(len(mutual_matches(a, b, BRUTE_FORCE_BITS).pairs))


class PretrainedVocabulary:
    """Bags of words as DBoW2 has them: a k-means tree and idf of other images, and neither ever changes."""

    def __init__(self, training: Sequence[Codes], seed: int, shape: TreeShape = FOREIGN_SHAPE) -> None:
        """Grow the tree on the descriptors (N, 32) of each of the other images."""
        images = [code_words(codes) for codes in training]
        self._tree: Tree = grow_tree(np.concatenate(images), shape, np.uint64(seed))
        documents = np.zeros(len(self._tree.centres))
        for codes in images:
            documents[np.unique(find_leaves(self._tree, codes))] += 1.0
        self._idf = np.log(len(images) / np.maximum(documents, 1.0))

    @property
    def word_count(self) -> int:
        """Number of leaves."""
        return int((self._tree.child_count == 0).sum())

    def bag(self, descriptors: Codes) -> BagOfWords:
        """The words of descriptors (N, 32)."""
        return bag_of_words(find_leaves(self._tree, code_words(descriptors)).astype(np.int64), self._idf, 0)

    def __call__(self, described: DescribedSet) -> FloatArray:
        """The scores of DBoW2: sum of min over the words."""
        bags = [self.bag(place.descriptors) for place in described.gallery]
        ends = np.cumsum([0, *(len(bag.words) for bag in bags)])
        words, values = (np.concatenate(parts) for parts in zip(*((b.words, b.values) for b in bags), strict=True))
        scores = np.zeros(described.place_set.admitted.shape)
        for q, query in enumerate(described.queries):
            bag, dense = self.bag(query.descriptors), np.zeros(len(self._idf))
            dense[bag.words] = bag.values
            scores[q] = _common(dense, ends, words, values)
        return np.where(described.place_set.admitted, scores, 0.0)


def strategy_scorer(config: VocabularyConfig, seed: int) -> Scorer:
    """The fleet's own index: places arrive in the order of the set, and queries see those that are admitted."""

    def score(described: DescribedSet) -> FloatArray:
        index: PlaceIndex[int] = PlaceIndex(config, np.random.default_rng(seed))
        return index_scores(index, described)

    return score


def index_scores(index: PlaceIndex[int], described: DescribedSet) -> FloatArray:
    """Put the gallery into ``index`` under its numbers from 0 and ask; of a stream, each place before it is added."""
    admitted = described.place_set.admitted
    count = admitted.shape[1]
    scores = np.zeros(admitted.shape)

    def ask(q: int) -> None:
        barred = {int(g) for g in np.flatnonzero(~admitted[q])}
        for found in index.query(described.queries[q].descriptors, count, barred):
            scores[q, found.id] = found.similarity

    online = described.place_set.is_online
    for g, place in enumerate(described.gallery):
        if online:
            ask(g)
        index.add(g, place.descriptors)
    if not online:
        for q in range(len(described.queries)):
            ask(q)
    return scores


def choose_scorers(
    strategies: Sequence[Strategy], vocabulary: VocabularyConfig, training: Sequence[Codes], seed: int
) -> Mapping[str, Scorer]:
    """Brute force, the foreign tree if there are other images to train it on, and the index with each strategy."""
    scorers: dict[str, Scorer] = {BRUTE_FORCE: brute_force}
    if training:
        scorers[FOREIGN_TREE] = PretrainedVocabulary(training, seed)
    for strategy in strategies:
        scorers[strategy] = strategy_scorer(vocabulary.model_copy(update={"strategy": strategy}), seed)
    return scorers


@njit(cache=True)
def _common(query: FloatArray, ends: NDArray[np.int64], words: NDArray[np.int64], values: FloatArray) -> FloatArray:
    """Sum of min(query, place) for every place; its words and values are from ``ends[k]`` to ``ends[k + 1]``."""
    scores = np.zeros(len(ends) - 1)
    for place in range(len(ends) - 1):
        for entry in range(ends[place], ends[place + 1]):
            scores[place] += min(query[words[entry]], values[entry])
    return scores
