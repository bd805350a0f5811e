"""Visual vocabulary: a k-means tree over binary descriptors that can go on growing where descriptors arrive.

A word is a leaf; finding it takes branching x depth comparisons. Leaves may split and merge, all other centres stay as
they are: then every other descriptor's word stays as well. Numbers of words are never given twice.
"""

from dataclasses import dataclass
from enum import StrEnum
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from fcslam.config import Settings
from fcslam.features.codes import CodeWords
from fcslam.places.kmeans_tree import Tree, TreeShape, bare_root, find_leaves, grow_tree, k_means
from fcslam.places.postings import GROWTH_FACTOR, grown_rows


class Strategy(StrEnum):
    """When the vocabulary changes."""

    STATIC = "static"
    REBUILD = "rebuild"
    WINDOWED = "windowed"
    INCREMENTAL = "incremental"


class Scoring(StrEnum):
    """What a query counts."""

    WORDS = "words"
    MATCHES = "matches"


class TreeConfig(Settings):
    """Shape of the k-means tree where it is trained."""

    branching: int = Field(default=8, ge=2, le=64, description="children of a tree vertex")
    depth: int = Field(default=4, ge=1, le=8, description="levels below the root; at most branching ** depth words")
    smallest_split: int = Field(default=20, ge=2, description="a cluster of fewer descriptors stays one word")
    iterations: int = Field(default=8, ge=1, le=100, description="rounds of k-means per cluster, at most")

    @property
    def shape(self) -> TreeShape:
        """As compiled code has it."""
        return TreeShape(self.branching, self.depth, self.smallest_split, self.iterations)


class VocabularyConfig(Settings):
    """The vocabulary of places, and how it follows them. ``rebuild`` is Algorithm 1 to the letter."""

    strategy: Strategy = Field(
        default=Strategy.INCREMENTAL,
        description="static: trained once; rebuild: at every place; windowed: at every rebuild_every-th; incremental: "
        "words split as they fill",
    )
    train_batch: int = Field(default=20, ge=0, description="Algorithm 1's L: places before the first training")
    capacity: int = Field(default=300, ge=1, description="Algorithm 1's C: the newest places that are trained on")
    rebuild_every: int = Field(default=20, ge=1, description="windowed: places between two trainings")
    tree: TreeConfig = Field(default=TreeConfig(), description="shape of the tree where it is trained")
    leaf_capacity: int = Field(default=128, ge=2, description="incremental: a word of more descriptors splits")
    scoring: Scoring = Field(
        default=Scoring.MATCHES,
        description="words: eq. (4) on [0, 1]; matches: words propose descriptors, their bits decide",
    )
    beam: int = Field(default=4, ge=1, le=64, description="matches: words looked through for a descriptor")
    near_bits: int = Field(default=56, ge=0, le=256, description="matches: descriptors of no more differing bits match")


@dataclass(frozen=True, slots=True)
class Training:
    """What a vocabulary was trained on."""

    places: int
    descriptors: int
    descriptor_version: str
    """Of the detector; empty if not told."""


class TreeState(NamedTuple):
    """A tree whose vertices are numbered level by level, so that the numbers of children say where they are."""

    seed: int
    version: int
    words_given: int
    centres: CodeWords
    """Shape (V, 4)."""
    child_count: NDArray[np.int32]
    """Shape (V,)."""
    words: NDArray[np.int64]
    """Shape (V,)."""


class Vocabulary:
    """The living tree. Leaves are numbered as vertices while they live, as words for ever."""

    def __init__(self, shape: TreeShape, seed: int) -> None:
        self._shape, self._seed = shape, seed
        self.tree = bare_root()
        self.words = np.zeros(1, np.int64)
        """Shape (V,): the number of each leaf's word, -1 for other vertices."""
        self.parents = np.full(1, -1, np.int32)
        """Shape (V,): the vertex above; -1 for the root."""
        self.vertex_count = 1
        self.version = 0
        """Counts the changes: words of different versions must not be compared."""
        self._words_given = 1
        self._free: dict[int, list[int]] = {}
        """First vertices of families that merged, by their size."""

    @property
    def word_count(self) -> int:
        """Number of words."""
        return int((self.words >= 0).sum())

    def train(self, codes: CodeWords) -> None:
        """Grow a new tree from codes (N, 4)."""
        self.version += 1
        self.tree = grow_tree(codes, self._shape, self._state(self.version)[0])
        self.vertex_count = len(self.tree.centres)
        leaves = np.flatnonzero(self.tree.child_count == 0)
        self.words = np.full(self.vertex_count, -1, np.int64)
        self.words[leaves] = self._words_given + np.arange(len(leaves))
        self._words_given += len(leaves)
        self.parents = _parents(self.tree.child_count)
        self._free.clear()

    def state(self) -> tuple[TreeState, NDArray[np.int32]]:
        """The tree without gaps, and the new number of every vertex (V,)."""
        order = level = np.zeros(1, np.int64)
        while len(level):
            counts = self.tree.child_count[level]
            before = np.cumsum(counts) - counts
            level = np.repeat(self.tree.first_child[level] - before, counts) + np.arange(counts.sum())
            order = np.concatenate([order, level])
        number_of = np.full(self.vertex_count, -1, np.int32)
        number_of[order] = np.arange(len(order))
        centres, child_count = self.tree.centres[order], self.tree.child_count[order]
        tree = TreeState(self._seed, self.version, self._words_given, centres, child_count, self.words[order])
        return tree, number_of

    @classmethod
    def restored(cls, shape: TreeShape, state: TreeState) -> Self:
        """The vocabulary that had this state."""
        vocabulary = cls(shape, state.seed)
        counts = state.child_count
        first_child = np.where(counts > 0, 1 + np.cumsum(counts) - counts, 0).astype(np.int32)
        vocabulary.tree = Tree(state.centres, np.column_stack((first_child, counts)))
        vocabulary.words = state.words
        vocabulary.version, vocabulary._words_given = state.version, state.words_given
        vocabulary.vertex_count = len(counts)
        vocabulary.parents = _parents(counts)
        return vocabulary

    def leaves(self, codes: CodeWords) -> NDArray[np.int32]:
        """The vertex of the leaf of every code (N, 4), shape (N,); of equally near children the first is taken."""
        leaves: NDArray[np.int32] = find_leaves(self.tree, codes)
        return leaves

    def split(self, leaf: int, codes: CodeWords) -> NDArray[np.int32] | None:
        """Split a leaf by the codes (N, 4) that lie in it; returns the new leaf of each, None if all are equal.

        The same word splits the same codes in the same way, whatever else has happened.
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
        """Make a vertex whose children are leaves one new word."""
        children = self.children(parent)
        self._free.setdefault(children.stop - children.start, []).append(children.start)
        self.words[children] = -1
        self.tree.families[parent], self.words[parent] = 0, self._words_given
        self._words_given += 1
        self.version += 1

    def children(self, vertex: int) -> slice:
        """Of a vertex, in arrays of vertices."""
        first, count = self.tree.families[vertex].tolist()
        return slice(first, first + count)

    def _family(self, size: int) -> int:
        """The first of so many vertices in a row that are free."""
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
        """Random numbers of their own for each training and each word."""
        return np.random.SeedSequence((self._seed, number)).generate_state(1, np.uint64).astype(np.uint64)


def _parents(child_count: NDArray[np.int32]) -> NDArray[np.int32]:
    """The vertex above each one of a tree that is numbered level by level."""
    return np.concatenate([[-1], np.repeat(np.arange(len(child_count)), child_count)]).astype(np.int32)
