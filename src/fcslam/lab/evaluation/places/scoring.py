"""Scorers of the place evaluation: the fleet's place index with each strategy, and baselines.

Each computes similarities (Q, G) of queries and gallery; 0 if a place is not retrieved or not admitted.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from fcslam.compiled import njit
from fcslam.features.codes import code_words, mutual_matches
from fcslam.lab.evaluation.places.sets import PlaceSet
from fcslam.places.index import PlaceIndex
from fcslam.places.kmeans_tree import Tree, TreeShape, find_leaves, grow_tree
from fcslam.places.similarity import BagOfWords, bag_of_words
from fcslam.places.vocabulary import Strategy, VocabularyConfig
from fcslam.records import Codes, FloatArray

BRUTE_FORCE_BITS: Final = 48
"""Largest Hamming distance of matching descriptors."""
BRUTE_FORCE, FOREIGN_TREE = "brute force", "foreign tree"
FOREIGN_SHAPE: Final = TreeShape(branching=10, depth=4, smallest_split=2, iterations=8)
"""The usual tree of DBoW2: 10 children, 4 levels."""


@dataclass(frozen=True, slots=True)
class PlaceFeatures:
    """Features of a place."""

    positions: NDArray[np.float32]
    """Shape (N, 2): pixels of an image, or metres in the coordinate frame of a submap."""
    descriptors: Codes
    """Shape (N, 32)."""


@dataclass(frozen=True, slots=True)
class DescribedSet:
    """A set of places with the features of each."""

    place_set: PlaceSet
    queries: Sequence[PlaceFeatures]
    gallery: Sequence[PlaceFeatures]
    count_inliers: Callable[[PlaceFeatures, PlaceFeatures], int]
    """Geometric verification: number of inliers of two places."""


Scorer = Callable[[DescribedSet], FloatArray]


def brute_force(described: DescribedSet) -> FloatArray:
    """Number of mutual nearest neighbours at most 48 bits apart, for all admitted pairs: shape (Q, G)."""
    scores = np.zeros(described.place_set.admitted.shape)
    for q, g in np.argwhere(described.place_set.admitted):
        scores[q, g] = matching_descriptors(described.queries[q].descriptors, described.gallery[g].descriptors)
    return scores


def matching_descriptors(a: Codes, b: Codes) -> float:
    """Number of mutual nearest neighbours at most 48 bits apart of descriptors (N, 32) and (M, 32)."""
    return float(len(mutual_matches(a, b, BRUTE_FORCE_BITS).pairs))


class PretrainedVocabulary:
    """Bags of words as in DBoW2: a tree and idf weights trained offline on other images, which never change."""

    def __init__(self, training: Sequence[Codes], seed: int) -> None:
        """Train the tree on the descriptors (N, 32) of each training image."""
        images = [code_words(codes) for codes in training]
        self._tree: Tree = grow_tree(np.concatenate(images), FOREIGN_SHAPE, np.uint64(seed))
        documents = np.zeros(len(self._tree.centres))
        for codes in images:
            documents[np.unique(find_leaves(self._tree, codes))] += 1.0
        self._idf = np.log(len(images) / np.maximum(documents, 1.0))

    @property
    def word_count(self) -> int:
        """Number of leaves."""
        return int((self._tree.child_count == 0).sum())

    def bag(self, descriptors: Codes) -> BagOfWords:
        """Bag of words of descriptors (N, 32)."""
        return bag_of_words(find_leaves(self._tree, code_words(descriptors)).astype(np.int64), self._idf, 0)

    def __call__(self, described: DescribedSet) -> FloatArray:
        """L1 scores of DBoW2, shape (Q, G): sum of min over the words."""
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
    """Scorer of the fleet's place index: places arrive in the order of the set, and queries see the admitted ones."""

    def score(described: DescribedSet) -> FloatArray:
        index: PlaceIndex[int] = PlaceIndex(config, np.random.default_rng(seed))
        return index_scores(index, described)

    return score


def index_scores(index: PlaceIndex[int], described: DescribedSet) -> FloatArray:
    """Add the gallery to ``index`` and query it: shape (Q, G). A stream queries each place before it is added."""
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
    """Brute force, the pretrained vocabulary if there are training images, and the index with each strategy."""
    scorers: dict[str, Scorer] = {BRUTE_FORCE: brute_force}
    if training:
        scorers[FOREIGN_TREE] = PretrainedVocabulary(training, seed)
    for strategy in strategies:
        scorers[strategy] = strategy_scorer(vocabulary.model_copy(update={"strategy": strategy}), seed)
    return scorers


@njit
def _common(query: FloatArray, ends: NDArray[np.int64], words: NDArray[np.int64], values: FloatArray) -> FloatArray:
    """Sum of min(query, place) for every place, whose words and values are from ``ends[k]`` to ``ends[k + 1]``."""
    scores = np.zeros(len(ends) - 1)
    for place in range(len(ends) - 1):
        for entry in range(ends[place], ends[place + 1]):
            scores[place] += min(query[words[entry]], values[entry])
    return scores
