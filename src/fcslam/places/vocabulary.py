"""Visual vocabulary: a k-means tree over binary descriptors, and the vocabulary that grows with the places.

The centres are binary too: each bit is the majority of its cluster. A word is a leaf; finding it takes
branching x depth comparisons.
"""

from collections import deque
from collections.abc import Collection
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from fcslam.config import Settings
from fcslam.features.codes import code_words
from fcslam.places.kmeans_tree import Tree, TreeShape, descend, grow
from fcslam.places.similarity import BagOfWords, bag_of_words
from fcslam.records import CODE_BYTES, Codes, FloatArray, frozen


class VocabularyConfig(Settings):
    """Shape of the k-means tree."""

    branching: int = Field(default=16, ge=2, le=64, description="children of a tree vertex")
    depth: int = Field(default=3, ge=1, le=8, description="levels below the root; at most branching ** depth words")
    smallest_split: int = Field(default=20, ge=2, description="a cluster of fewer descriptors stays one word")
    iterations: int = Field(default=8, ge=1, le=100, description="rounds of k-means per cluster, at most")


@dataclass(frozen=True, slots=True)
class Vocabulary:
    """A tree and how much each of its words tells."""

    tree: Tree
    """Its leaves are the words."""
    idf: FloatArray
    """Shape (word_count,): ln(N / N_w) over the N places it was trained on, N_w of which have the word."""
    version: int
    """Words of different versions must not be compared."""

    @property
    def word_count(self) -> int:
        """Number of words."""
        return len(self.idf)

    def words(self, descriptors: Codes) -> NDArray[np.int64]:
        """The word of every descriptor (N, 32), shape (N,); of equally near children the first is taken."""
        words: NDArray[np.int64] = descend(self.tree, code_words(descriptors))
        return words

    def bag(self, descriptors: Codes) -> BagOfWords:
        """The place with these descriptors (N, 32) as weighted words."""
        return bag_of_words(self.words(descriptors), self.idf, self.version)


def train(
    places: Collection[Codes], config: VocabularyConfig, rng: np.random.Generator, version: int = 0
) -> Vocabulary:
    """A vocabulary of the descriptors of ``places``, each (N, 32); it has one word if there are none."""
    codes = code_words(np.concatenate([np.empty((0, CODE_BYTES), np.uint8), *places]))
    shape = TreeShape(config.branching, config.depth, config.smallest_split, config.iterations)
    tree = grow(codes, shape, rng.integers(0, 2**63, dtype=np.uint64))
    for array in tree:
        array.setflags(write=False)
    documents = np.zeros(int((tree.child_count == 0).sum()))
    for place in places:
        documents[np.unique(descend(tree, code_words(place)))] += 1.0
    idf = np.log(max(len(places), 1) / np.maximum(documents, 1.0))
    return Vocabulary(tree, frozen(idf), version)


class DynamicVocabularyConfig(Settings):
    """When the vocabulary is trained again. ``rebuild_every`` = 1 is Algorithm 1 to the letter."""

    train_batch: int = Field(default=20, ge=0, description="Algorithm 1's L: places before the first training")
    capacity: int = Field(default=300, ge=1, description="Algorithm 1's C: the newest places that are trained on")
    rebuild_every: int = Field(default=20, ge=1, description="places between two trainings")
    tree: VocabularyConfig = Field(default=VocabularyConfig(), description="shape of the tree")


class DynamicVocabulary:
    """Algorithm 1 of FC-SLAM (lines 1-11, 19): a vocabulary trained again on the newest places as they arrive.

    Places are counted over all robots in the order of arrival, from 0.
    """

    def __init__(self, config: DynamicVocabularyConfig, rng: np.random.Generator) -> None:
        self._config = config
        self._rng = rng
        self._window: deque[Codes] = deque(maxlen=config.capacity)
        self._places_seen = 0
        self._vocabulary: Vocabulary | None = None

    @property
    def vocabulary(self) -> Vocabulary | None:
        """V_t; None before the first training. Its version counts the trainings from 1."""
        return self._vocabulary

    def add(self, descriptors: Codes) -> bool:
        """Receive the descriptors (N, 32) of the next place; True if the vocabulary was trained again.

        The paper's frame i is the place; its two cases of lines 5-9 are one window here.
        """
        L, n = self._config.train_batch, self._config.rebuild_every
        i = self._places_seen
        self._places_seen += 1
        self._window.append(descriptors)  # lines 3, 6, 8: D = {D_max(0, i - C + 1) ... D_i}
        if i <= L or (i - L - 1) % n:  # line 4; n = 1 in the paper
            return False
        version = self._vocabulary.version + 1 if self._vocabulary else 1
        self._vocabulary = train(self._window, self._config.tree, self._rng, version)  # lines 6, 8, 11
        return True
