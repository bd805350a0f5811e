"""The place index: which stored places are like a new one, in words that follow the places as they arrive."""

from collections.abc import Callable, Container, Sequence
from typing import Any, Generic, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from fcslam.features.codes import CODE_WORDS, CodeWords, code_words
from fcslam.places.postings import Postings
from fcslam.places.scoring import TINY, score_matches, score_words
from fcslam.places.similarity import BagOfWords, similarity
from fcslam.places.vocabulary import Scoring, Strategy, Training, Vocabulary, VocabularyConfig
from fcslam.records import Codes, FloatArray

PlaceId = TypeVar("PlaceId")


_MOST_LEVELS = 16
"""Of a tree whose leaves split: no limit in practice."""
_MERGED_SHARE = 4
"""A merged word is at most so much smaller than one that splits, so that it does not split again at once."""
_ROWS_KEPT = 2
"""Rows for every stored place at most: those of forgotten ones are closed up then."""
_NO_ROWS, _NO_SCORES = np.empty(0, np.int32), np.empty(0)
_NO_CODES = np.empty((0, CODE_WORDS), np.uint64)


class Found(NamedTuple, Generic[PlaceId]):
    """A stored place that is like the query."""

    id: PlaceId
    similarity: float
    """In [0, 1], as ``VocabularyConfig.scoring`` has it."""


class Likeness(Generic[PlaceId]):
    """How alike all stored places are to one query. Valid until the index changes."""

    def __init__(
        self,
        ids: Sequence[PlaceId] = (),
        rows: NDArray[np.int32] = _NO_ROWS,
        scores: FloatArray = _NO_SCORES,
    ) -> None:
        self._ids, self._rows, self._scores = ids, rows, scores
        self._by_place: dict[PlaceId, float] | None = None

    def of(self, place: PlaceId, default: float = 0.0) -> float:
        """The similarity of one place, ``default`` if it has nothing in common with the query."""
        if self._by_place is None:
            ids = (self._ids[row] for row in self._rows)
            self._by_place = dict(zip(ids, self._scores.tolist(), strict=True))
        return self._by_place.get(place, default)

    def best(self, top_k: int, wanted: Callable[[PlaceId], bool] = lambda _: True) -> list[Found[PlaceId]]:
        """The most similar places of those wanted, the most similar first; of equals the one stored first comes first.

        Places that have nothing in common with the query are never among them.
        """
        found: list[Found[PlaceId]] = []
        looked_at, count = 0, 2 * top_k + 16
        while looked_at < len(self._rows) and len(found) < top_k:
            order = self._order(count)
            for position in order[looked_at:]:
                place = self._ids[self._rows[position]]
                if wanted(place):
                    found.append(Found(place, float(self._scores[position])))
                    if len(found) == top_k:
                        break
            looked_at, count = len(order), 4 * count
        return found

    def _order(self, count: int) -> NDArray[np.int64]:
        """The first ``count`` positions at least, by falling score, then by row."""
        if count >= len(self._rows):
            return np.lexsort((self._rows, -self._scores))
        least = np.partition(self._scores, len(self._scores) - count)[len(self._scores) - count]
        chosen = np.flatnonzero(self._scores >= least)
        return chosen[np.lexsort((self._rows[chosen], -self._scores[chosen]))]


class PlaceIndex(Generic[PlaceId]):
    """Places by the words they contain, and the vocabulary that follows them.

    The strategies differ in when the tree is grown again and whether words split; all else is the same. Places are
    counted in the order of arrival, from 0, as in Algorithm 1 of FC-SLAM.
    """

    def __init__(self, config: VocabularyConfig, rng: np.random.Generator, descriptor_version: str = "") -> None:
        self._config = config
        self._descriptor_version = descriptor_version
        shape = config.tree.shape
        if config.strategy is Strategy.INCREMENTAL:
            shape = shape._replace(depth=_MOST_LEVELS, smallest_split=config.leaf_capacity + 1)
        self._vocabulary = Vocabulary(shape, int(rng.integers(0, 2**63)))
        self._postings = Postings(vertices=1)
        self._ids: list[PlaceId] = []
        """By row; what stood there once stays after the place was forgotten, until rows are closed up."""
        self._row_of: dict[PlaceId, int] = {}
        self._places_seen = 0
        self._training: Training | None = None

    def __len__(self) -> int:
        return len(self._row_of)

    def __contains__(self, place: PlaceId) -> bool:
        return place in self._row_of

    @property
    def word_count(self) -> int:
        """Words of the vocabulary; 0 before the first training."""
        return self._vocabulary.word_count if self._training else 0

    @property
    def version(self) -> int:
        """Counts the changes of the vocabulary; 0 before the first training."""
        return self._vocabulary.version

    @property
    def training(self) -> Training | None:
        """What the tree was grown from; None before."""
        return self._training

    def add(self, place: PlaceId, descriptors: Codes) -> None:
        """Store a place with its descriptors (N, 32): Algorithm 1, lines 3-11.

        Raises:
            ValueError: the place is stored already, or the descriptors are malformed.
        """
        if place in self._row_of:
            raise ValueError(f"place {place} is in the index already")
        codes = code_words(descriptors)
        leaves = self._vocabulary.leaves(codes)
        self._row_of[place] = self._postings.add(codes, leaves)
        self._ids.append(place)
        i = self._places_seen
        self._places_seen += 1
        if self._is_due(i):
            self._train_on_newest()
        elif self._training and self._config.strategy is Strategy.INCREMENTAL:
            self._split(self._overfull(*np.unique(leaves, return_counts=True)))

    def query(self, descriptors: Codes, top_k: int, exclude: Container[PlaceId] = frozenset()) -> list[Found[PlaceId]]:
        """The ``top_k`` stored places most similar to these descriptors (N, 32): the best of ``compare``."""
        return self.compare(descriptors).best(top_k, lambda place: place not in exclude)

    def compare(self, descriptors: Codes) -> Likeness[PlaceId]:
        """How alike all stored places are to these descriptors (N, 32); nothing before the first training."""
        codes = code_words(descriptors)
        entries, row_count, count = self._postings.entries, self._postings.row_count, len(self)
        if not self._training or not count:
            return Likeness()
        if self._config.scoring is Scoring.MATCHES:
            beam, near_bits = self._config.beam, self._config.near_bits
            rows, scores = score_matches(entries, self._vocabulary.tree, row_count, count, codes, beam, near_bits)
        else:
            leaves, weights = self._weigh(codes)
            rows, scores = score_words(entries, row_count, count, leaves, weights)
        return Likeness(self._ids, rows, scores)

    def similarity(self, a: Codes, b: Codes) -> float:
        """Eq. (4) on [0, 1] of two places, each (N, 32), in the present words; 0 before the first training."""
        if not self._training:
            return 0.0
        return similarity(self.bag(a), self.bag(b))

    def bag(self, descriptors: Codes) -> BagOfWords:
        """The place with these descriptors (N, 32) in the present words, weighted as stored places are."""
        leaves, weights = self._weigh(code_words(descriptors))
        words = self._vocabulary.words[leaves]
        order = np.argsort(words)
        return BagOfWords(words[order], weights[order], self.version)

    def forget(self, place: PlaceId) -> None:
        """Take a place out.

        Raises:
            KeyError: it is not stored.
        """
        leaves = self._postings.forget(self._row_of.pop(place))
        if self._training and self._config.strategy is Strategy.INCREMENTAL:
            self._merge(leaves)
        if self._postings.row_count > _ROWS_KEPT * (len(self) + 1):
            self._describe_again(self._postings.gather(self._rows()))

    def train(self, places: Sequence[Codes]) -> None:
        """Grow the tree now from the descriptors of these places, each (N, 32), which need not be stored."""
        self._train(np.concatenate([_NO_CODES, *map(code_words, places)]), len(places))

    def _is_due(self, i: int) -> bool:
        """Algorithm 1, line 4: whether the tree is grown when place i has come."""
        since = i - self._config.train_batch - 1
        match self._config.strategy:
            case Strategy.REBUILD:
                return since >= 0
            case Strategy.WINDOWED:
                return since >= 0 and since % self._config.rebuild_every == 0
            case _:
                return since >= 0 and self._training is None

    def _train_on_newest(self) -> None:
        """Lines 5-9, whose two cases are one window here: D_max(0, i - C + 1) ... D_i."""
        rows = self._rows()[-self._config.capacity :]
        self._train(self._postings.gather(rows), len(rows))

    def _train(self, codes: CodeWords, places: int) -> None:
        """Line 11: V_t, and all stored places in its words."""
        stored = self._postings.gather(self._rows())
        self._vocabulary.train(codes)
        self._training = Training(places, len(codes), self._descriptor_version)
        self._describe_again(stored)
        if self._config.strategy is Strategy.INCREMENTAL:
            self._split(np.flatnonzero(self._postings.entries.sizes > self._config.leaf_capacity))

    def _describe_again(self, stored: CodeWords) -> None:
        """Enter all stored places anew, ``stored`` (M, 4) being their codes; rows close up."""
        counts = self._postings.entries.counts[self._rows()]
        self._postings = Postings(self._vocabulary.vertex_count)
        self._postings.add_all(stored, self._vocabulary.leaves(stored), counts)
        self._ids = list(self._row_of)
        self._row_of = {place: row for row, place in enumerate(self._ids)}

    def _rows(self) -> NDArray[np.int64]:
        """Of the stored places, ascending."""
        return np.fromiter(self._row_of.values(), np.int64, len(self))

    def _overfull(self, leaves: NDArray[np.int32], added: NDArray[np.int64]) -> NDArray[np.int32]:
        """Those of the leaves that have grown over the limit, or over twice, four times ... the limit.

        A word of equal descriptors cannot be split; it is not tried again with each one more.
        """
        capacity = self._config.leaf_capacity
        after = self._postings.entries.sizes[leaves]
        limit = capacity * 2.0 ** np.floor(np.log2(np.maximum(after - 1, 1) / capacity))
        return leaves[(after > capacity) & (after - added <= limit)]

    def _split(self, overfull: NDArray[np.integer[Any]]) -> None:
        """Split words that hold too many descriptors, and what they split into."""
        waiting = [int(leaf) for leaf in overfull]
        while waiting:
            leaf = waiting.pop()
            _, codes = self._postings.content((leaf,))
            targets = self._vocabulary.split(leaf, codes)
            if targets is None:
                continue
            self._postings.grow_vertices(self._vocabulary.vertex_count)
            self._postings.move((leaf,), targets)
            sizes = self._postings.entries.sizes
            waiting += [int(child) for child in np.unique(targets) if sizes[child] > self._config.leaf_capacity]

    def _merge(self, leaves: NDArray[np.int32]) -> None:
        """Merge words that have become nearly empty with their siblings, level by level."""
        waiting = {int(self._vocabulary.parents[leaf]) for leaf in leaves}
        while waiting:
            vertex = max(waiting)
            waiting.remove(vertex)
            children = self._vocabulary.children(vertex) if vertex >= 0 else slice(0, 0)
            size = int(self._postings.entries.sizes[children].sum())
            is_lowest = children.stop > children.start and not self._vocabulary.tree.child_count[children].any()
            if is_lowest and size <= self._config.leaf_capacity // _MERGED_SHARE:
                self._postings.move(range(children.start, children.stop), np.full(size, vertex, np.int32))
                self._vocabulary.merge(vertex)
                waiting.add(int(self._vocabulary.parents[vertex]))

    def _weigh(self, codes: CodeWords) -> tuple[NDArray[np.int32], FloatArray]:
        """Leaves, each once, and tf-idf with an L1 norm of 1. Words that all or no places have tell nothing."""
        leaves, counts = np.unique(self._vocabulary.leaves(codes), return_counts=True)
        documents = self._postings.entries.documents[leaves]
        weights = counts * np.log(max(len(self), 1) / np.maximum(documents, 1))
        telling = weights > 0.0
        values: FloatArray = weights[telling] / max(weights.sum(), TINY)
        return leaves[telling], values
