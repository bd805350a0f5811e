"""Inverted index: which stored places share words with a new one, and how alike they are."""

from collections.abc import Container
from typing import Generic, NamedTuple, TypeVar

import numpy as np
from numba import njit
from numpy.typing import NDArray

from fcslam.places.similarity import BagOfWords
from fcslam.places.vocabulary import Vocabulary
from fcslam.records import Codes, FloatArray, Scalar

PlaceId = TypeVar("PlaceId")

_BLOCK = 16
_FIRST_BLOCKS = 256


class Found(NamedTuple, Generic[PlaceId]):
    """A stored place that shares words with the query."""

    id: PlaceId
    similarity: float
    """L1 score in [0, 1]."""


class _Blocks(NamedTuple):
    """Postings as compiled code sees them: every word has a chain of blocks of (place row, value)."""

    newest: NDArray[np.int64]
    """Shape (word_count,): the block of each word that is being filled, -1 for none."""
    older: NDArray[np.int64]
    """Shape (B,): the block before it of the same word, -1 for none."""
    sizes: NDArray[np.int64]
    """Shape (B,): entries in the block."""
    rows: NDArray[np.int32]
    """Shape (B, _BLOCK)."""
    values: FloatArray
    """Shape (B, _BLOCK)."""


class _Postings:
    """For every word the places that have it. Blocks, because a query is bound by memory: it reads them in a row."""

    def __init__(self, word_count: int) -> None:
        self.blocks = _Blocks(
            np.full(word_count, -1, np.int64),
            np.empty(_FIRST_BLOCKS, np.int64),
            np.empty(_FIRST_BLOCKS, np.int64),
            np.empty((_FIRST_BLOCKS, _BLOCK), np.int32),
            np.empty((_FIRST_BLOCKS, _BLOCK)),
        )
        self._used = 0

    def append(self, row: int, bag: BagOfWords) -> None:
        """Add a place; its cost does not depend on how many there are."""
        needed = self._used + len(bag.words)
        if needed > len(self.blocks.older):
            newest, older, sizes, rows, values = self.blocks
            longer = 2 * needed
            self.blocks = _Blocks(
                newest, _longer(older, longer), _longer(sizes, longer), _longer(rows, longer), _longer(values, longer)
            )
        self._used = _append(self.blocks, self._used, row, bag.words, bag.values)


def _longer(array: NDArray[Scalar], length: int) -> NDArray[Scalar]:
    """``array`` with room for ``length`` rows."""
    longer = np.empty((length, *array.shape[1:]), array.dtype)
    longer[: len(array)] = array
    return longer


class InvertedIndex(Generic[PlaceId]):
    """Places by the words they contain. It keeps their descriptors, so that a new vocabulary can describe them again.

    idf is the vocabulary's own, so a stored place never changes until the vocabulary does.
    """

    def __init__(self, vocabulary: Vocabulary) -> None:
        self._descriptors: dict[PlaceId, Codes] = {}
        self._ids: list[PlaceId] = []
        self._vocabulary = vocabulary
        self._postings = _Postings(vocabulary.word_count)

    def __len__(self) -> int:
        return len(self._ids)

    @property
    def vocabulary(self) -> Vocabulary:
        """The vocabulary that describes the places at present."""
        return self._vocabulary

    def add(self, place: PlaceId, descriptors: Codes) -> None:
        """Store a place with its descriptors (N, 32).

        Raises:
            ValueError: the place is stored already, or the descriptors are malformed.
        """
        if place in self._descriptors:
            raise ValueError(f"place {place} is in the index already")
        self._postings.append(len(self._ids), self._vocabulary.bag(descriptors))
        self._descriptors[place] = descriptors
        self._ids.append(place)

    def describe_again(self, vocabulary: Vocabulary) -> None:
        """Put every stored place into the words of another vocabulary."""
        self._vocabulary = vocabulary
        self._postings = _Postings(vocabulary.word_count)
        for row, place in enumerate(self._ids):
            self._postings.append(row, vocabulary.bag(self._descriptors[place]))

    def query(self, descriptors: Codes, top_k: int, exclude: Container[PlaceId] = frozenset()) -> list[Found[PlaceId]]:
        """The ``top_k`` stored places most similar to these descriptors (N, 32), the most similar first.

        Places without a common word are neither touched nor returned; of equals the one stored first comes first.
        """
        bag = self._vocabulary.bag(descriptors)
        rows, scores = _score(self._postings.blocks, bag.words, bag.values, len(self._ids))
        found: list[Found[PlaceId]] = []
        for position in np.lexsort((rows, -scores)):
            if len(found) >= top_k:
                break
            place = self._ids[rows[position]]
            if place not in exclude:
                found.append(Found(place, float(scores[position])))
        return found


@njit(cache=True)
def _append(blocks: _Blocks, used: int, row: int, words: NDArray[np.int64], values: FloatArray) -> int:
    """Enter the words of one place and return how many blocks are used then; there must be room for them."""
    for index in range(words.shape[0]):
        block = blocks.newest[words[index]]
        if block < 0 or blocks.sizes[block] == _BLOCK:
            blocks.older[used], blocks.sizes[used] = block, 0
            blocks.newest[words[index]] = block = used
            used += 1
        blocks.rows[block, blocks.sizes[block]] = row
        blocks.values[block, blocks.sizes[block]] = values[index]
        blocks.sizes[block] += 1
    return used


@njit(cache=True)
def _score(
    blocks: _Blocks, words: NDArray[np.int64], weights: FloatArray, place_count: int
) -> tuple[NDArray[np.int64], FloatArray]:
    """Sum of min(query, place) over the common words, for the places that have one."""
    scores = np.zeros(place_count)
    touched = np.empty(place_count, np.int64)
    count = 0
    for index in range(words.shape[0]):
        block = blocks.newest[words[index]]
        while block >= 0:
            for entry in range(blocks.sizes[block]):
                row = blocks.rows[block, entry]
                if scores[row] == 0.0:
                    touched[count] = row
                    count += 1
                scores[row] += min(weights[index], blocks.values[block, entry])
            block = blocks.older[block]
    return touched[:count], scores[touched[:count]]
