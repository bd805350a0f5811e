"""Visual vocabulary: a k-means tree over binary descriptors whose leaves can split and merge as descriptors arrive.

A word is a leaf; finding it takes branching x depth comparisons. A split or merge leaves all other centres unchanged,
so every other descriptor keeps its word. A word's number is never used again.
"""

from enum import StrEnum
from typing import Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from fcslam.config import Settings
from fcslam.features.codes import CodeWords
from fcslam.places.kmeans_tree import Tree, TreeShape, bare_root, find_leaves, grow_tree, k_means
from fcslam.places.postings import GROWTH_FACTOR, grown_rows
from fcslam.storage.state_file import State


class Strategy(StrEnum):
    """When the vocabulary changes."""

    REBUILD = "rebuild"
    WINDOWED = "windowed"
    INCREMENTAL = "incremental"


class Scoring(StrEnum):
    """The similarity measure of a query."""

    WORDS = "words"
    MATCHES = "matches"


class TreeConfig(Settings):
    """Shape of the k-means tree when it is trained."""

    branching: int = Field(default=8, ge=2, le=64, description="children of a tree vertex")
    depth: int = Field(
        default=4, ge=1, le=8, description="levels of the tree below the root; at most branching ** depth words"
    )

    @property
    def shape(self) -> TreeShape:
        """The same limits for compiled code."""
        return TreeShape(self.branching, self.depth, smallest_split=20, iterations=8)


class VocabularyConfig(Settings):
    """The dynamic vocabulary. The strategy ``rebuild`` is Algorithm 1 of FC-SLAM exactly."""

    strategy: Strategy = Field(
        default=Strategy.INCREMENTAL,
        description="when the vocabulary is trained. rebuild: at every place; windowed: whenever as many places more "
        "have come as before the first training; incremental: once, then words split as they fill",
    )
    train_batch: int = Field(
        default=20, ge=0, description="places before the first training of the vocabulary (L of Algorithm 1)"
    )
    capacity: int = Field(
        default=300, ge=1, description="newest places that the vocabulary is trained on (C of Algorithm 1)"
    )
    tree: TreeConfig = Field(default=TreeConfig(), description="shape of the vocabulary tree when it is trained")
    leaf_capacity: int = Field(
        default=128, ge=2, description="most descriptors of a word before it splits, strategy incremental"
    )
    scoring: Scoring = Field(
        default=Scoring.MATCHES,
        description="similarity of two places. words: eq. (4) of FC-SLAM scaled to [0, 1]; matches: weighted share of "
        "matching descriptors, which the words only preselect",
    )
    beam: int = Field(
        default=4, ge=1, le=64, description="words that are searched for each descriptor of a query, scoring matches"
    )


class Vocabulary:
    """The tree and its words. A vertex number is reused after a merge; a word number never is."""

    def __init__(self, shape: TreeShape, seed: int) -> None:
        self._shape, self._seed = shape, seed
        self.tree = bare_root()
        self.words = np.zeros(1, np.int64)
        """Shape (V,): the number of each leaf's word, -1 for other vertices."""
        self.parents = np.full(1, -1, np.int32)
        """Shape (V,): the vertex above; -1 for the root."""
        self.vertex_count = 1
        self.version = 0
        """Number of changes so far. Words of different versions must not be compared."""
        self._words_given = 1
        self._free: dict[int, list[int]] = {}
        """First vertices of unused families of children, by the family's size."""

    @property
    def word_count(self) -> int:
        """Number of words."""
        return int((self.words >= 0).sum())

    def train(self, codes: CodeWords) -> None:
        """Train a new tree on codes (N, 4)."""
        self.version += 1
        self.tree = grow_tree(codes, self._shape, self._state(self.version)[0])
        self.vertex_count = len(self.tree.centres)
        leaves = np.flatnonzero(self.tree.child_count == 0)
        self.words = np.full(self.vertex_count, -1, np.int64)
        self.words[leaves] = self._words_given + np.arange(len(leaves))
        self._words_given += len(leaves)
        self.parents = _parents(self.tree.child_count)
        self._free.clear()

    def state(self) -> tuple[State, NDArray[np.int32]]:
        """The tree in storage order, and the number there of every present vertex (V,), -1 for unused ones.

        Vertices are numbered level by level, so the child counts determine all children.
        """
        order = level = np.zeros(1, np.int64)
        while len(level):
            counts = self.tree.child_count[level]
            before = np.cumsum(counts) - counts
            level = np.repeat(self.tree.first_child[level] - before, counts) + np.arange(counts.sum())
            order = np.concatenate([order, level])
        number_of = np.full(self.vertex_count, -1, np.int32)
        number_of[order] = np.arange(len(order))
        tree = {
            "seed": self._seed,
            "version": self.version,
            "words_given": self._words_given,
            "centres": self.tree.centres[order],
            "child_count": self.tree.child_count[order],
            "words": self.words[order],
        }
        return tree, number_of

    @classmethod
    def restored(cls, shape: TreeShape, state: State) -> Self:
        """Restore a vocabulary from its state."""
        vocabulary = cls(shape, state["seed"])
        counts = state["child_count"]
        first_child = np.where(counts > 0, 1 + np.cumsum(counts) - counts, 0).astype(np.int32)
        vocabulary.tree = Tree(state["centres"], np.column_stack((first_child, counts)))
        vocabulary.words = state["words"]
        vocabulary.version, vocabulary._words_given = state["version"], state["words_given"]
        vocabulary.vertex_count = len(counts)
        vocabulary.parents = _parents(counts)
        return vocabulary

    def leaves(self, codes: CodeWords) -> NDArray[np.int32]:
        """Find the leaf of every code (N, 4) as a vertex number, shape (N,); ties take the first child."""
        leaves: NDArray[np.int32] = find_leaves(self.tree, codes)
        return leaves

    def split(self, leaf: int, codes: CodeWords) -> NDArray[np.int32] | None:
        """Split a leaf by its codes (N, 4). Returns the new leaf of each, shape (N,), or None if all codes are equal.

        The result depends only on the word's number and the codes, not on earlier splits elsewhere.
        """
        centres, labels = k_means(codes, self._shape, self._state(int(self.words[leaf])))
        if len(centres) < 2:
            return None
        first = self._family(len(centres))
        family = slice(first, first + len(centres))
        self.tree.centres[family], self.tree.families[family], self.parents[family] = centres, 0, leaf
        self.words[family] = self._words_given + np.arange(len(centres))
        self._words_given += len(centres)
        self.tree.families[leaf], self.words[leaf] = (first, len(centres)), -1
        self.version += 1
        leaves: NDArray[np.int32] = (first + labels).astype(np.int32)
        return leaves

    def merge(self, parent: int) -> None:
        """Merge the children of a vertex, all of them leaves, into one new word."""
        children = self.children(parent)
        self._free.setdefault(children.stop - children.start, []).append(children.start)
        self.words[children] = -1
        self.tree.families[parent], self.words[parent] = 0, self._words_given
        self._words_given += 1
        self.version += 1

    def children(self, vertex: int) -> slice:
        """Slice of a vertex's children in arrays over vertices."""
        first, count = self.tree.families[vertex].tolist()
        return slice(first, first + count)

    def _family(self, size: int) -> int:
        """Allocate ``size`` consecutive vertices; returns the first."""
        if self._free.get(size):
            return self._free[size].pop()
        first = self.vertex_count
        self.vertex_count += size
        if self.vertex_count > len(self.words):
            length = max(self.vertex_count, int(GROWTH_FACTOR * len(self.words)))
            self.tree = Tree(grown_rows(self.tree.centres, length), grown_rows(self.tree.families, length))
            self.words, self.parents = grown_rows(self.words, length), grown_rows(self.parents, length)
            self.words[first:] = -1
        return first

    def _state(self, number: int) -> NDArray[np.uint64]:
        """State of the random generator of one training or one word, shape (1,)."""
        return np.random.SeedSequence((self._seed, number)).generate_state(1, np.uint64).astype(np.uint64)


def _parents(child_count: NDArray[np.int32]) -> NDArray[np.int32]:
    """Parent of every vertex, shape (V,), of a tree that is numbered level by level; -1 for the root."""
    return np.concatenate([[-1], np.repeat(np.arange(len(child_count)), child_count)]).astype(np.int32)
