"""Inverted index: which stored places share words with a new one, and how alike they are."""

from collections.abc import Container
from typing import Generic, NamedTuple, TypeVar

import numpy as np
from numba import njit
from numpy.typing import NDArray

from fcslam.places.similarity import BagOfWords
from fcslam.places.vocabulary import Vocabulary
from fcslam.records import Codes, FloatArray

PlaceId = TypeVar("PlaceId")


class Found(NamedTuple, Generic[PlaceId]):
    """A stored place that shares words with the query."""

    id: PlaceId
    similarity: float
    """L1 score in [0, 1]."""


class _Postings:
    """For every word a linked list of (place row, value), newest first, in arrays that double when full."""

    def __init__(self, word_count: int) -> None:
        self.newest = np.full(word_count, -1, np.int64)
        self.older = np.empty(1024, np.int64)
        self.rows = np.empty(1024, np.int64)
        self.values = np.empty(1024)
        self.size = 0

    def append(self, row: int, bag: BagOfWords) -> None:
        while self.size + len(bag.words) > len(self.rows):
            self.older = np.concatenate((self.older, np.empty_like(self.older)))
            self.rows = np.concatenate((self.rows, np.empty_like(self.rows)))
            self.values = np.concatenate((self.values, np.empty_like(self.values)))
        new = np.arange(self.size, self.size + len(bag.words))
        self.older[new] = self.newest[bag.words]
        self.newest[bag.words] = new
        self.rows[new] = row
        self.values[new] = bag.values
        self.size += len(new)


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
        postings = self._postings
        entries = (postings.newest, postings.older, postings.rows, postings.values)
        rows, scores = _score(bag.words, bag.values, entries, len(self._ids))
        found: list[Found[PlaceId]] = []
        for position in np.lexsort((rows, -scores)):
            if len(found) >= top_k:
                break
            place = self._ids[rows[position]]
            if place not in exclude:
                found.append(Found(place, float(scores[position])))
        return found


@njit(cache=True)
def _score(
    words: NDArray[np.int64],
    weights: FloatArray,
    entries: tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64], FloatArray],
    place_count: int,
) -> tuple[NDArray[np.int64], FloatArray]:
    """Sum of min(query, place) over the common words, for the places that have one."""
    newest, older, rows, values = entries
    scores = np.zeros(place_count)
    touched = np.empty(place_count, np.int64)
    count = 0
    for index in range(words.shape[0]):
        entry = newest[words[index]]
        while entry >= 0:
            row = rows[entry]
            if scores[row] == 0.0:
                touched[count] = row
                count += 1
            scores[row] += min(weights[index], values[entry])
            entry = older[entry]
    return touched[:count], scores[touched[:count]]
