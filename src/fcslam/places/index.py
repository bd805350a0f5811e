"""The place index: an inverted index over a dynamic vocabulary that retrieves the places most similar to a query."""

from collections.abc import Callable, Container, Sequence
from typing import Any, Generic, Self, TypeVar

import numpy as np
from numpy.typing import NDArray

from fcslam.features.codes import CODE_WORDS, CodeWords, code_words
from fcslam.places.kmeans_tree import TreeShape
from fcslam.places.postings import GROWTH_FACTOR, Postings
from fcslam.places.scoring import TINY, empty_buffers, score_matches, score_words
from fcslam.places.similarity import BagOfWords
from fcslam.places.vocabulary import Scoring, Strategy, Vocabulary, VocabularyConfig
from fcslam.records import Codes, FloatArray, frozen
from fcslam.storage.state_file import State

PlaceId = TypeVar("PlaceId")

_NO_ROWS, _NO_SCORES = np.empty(0, np.int32), np.empty(0)

_MOST_LEVELS = 16
"""Depth limit of a tree whose leaves split; no tree reaches it in practice."""
_MERGED_SHARE = 4
"""A merged word holds at most 1 / 4 of ``leaf_capacity``, so that it does not split again soon."""
_NO_CODES = np.empty((0, CODE_WORDS), np.uint64)


class QueryResult(Generic[PlaceId]):
    """Similarities of the stored places to one query. Valid until the index changes."""

    def __init__(
        self, ids: Sequence[PlaceId] = (), rows: NDArray[np.int32] = _NO_ROWS, scores: FloatArray = _NO_SCORES
    ) -> None:
        """Wrap the scores of a query.

        Args:
            ids: identifiers by row of the index.
            rows: shape (K,), rows that share a word or a descriptor with the query.
            scores: shape (K,), their similarities in [0, 1].
        """
        self._ids, self._rows, self._scores = ids, rows, scores
        self._by_place: dict[PlaceId, float] | None = None

    def similarity_of(self, place: PlaceId, default: float = 0.0) -> float:
        """Similarity of one place; ``default`` if it has nothing in common with the query."""
        if self._by_place is None:
            ids = (self._ids[row] for row in self._rows)
            self._by_place = dict(zip(ids, self._scores.tolist(), strict=True))
        return self._by_place.get(place, default)

    def best(self, top_k: int, wanted: Callable[[PlaceId], bool] = lambda _: True) -> list[tuple[PlaceId, float]]:
        """Return up to ``top_k`` places for which ``wanted`` holds, and their similarities in [0, 1].

        The most similar comes first, of equal ones that stored first. Places without anything in common are left out.
        """
        found: list[tuple[PlaceId, float]] = []
        looked_at, count = 0, 2 * top_k + 16
        while looked_at < len(self._rows) and len(found) < top_k:
            order = self._order(count)
            for position in order[looked_at:]:
                place = self._ids[self._rows[position]]
                if wanted(place):
                    found.append((place, float(self._scores[position])))
                    if len(found) == top_k:
                        break
            looked_at, count = len(order), 4 * count
        return found

    def _order(self, count: int) -> NDArray[np.int64]:
        """At least the first ``count`` positions in ``rows``, by descending score, then by row."""
        if count >= len(self._rows):
            return np.lexsort((self._rows, -self._scores))
        least = np.partition(self._scores, len(self._scores) - count)[len(self._scores) - count]
        chosen = np.flatnonzero(self._scores >= least)
        return chosen[np.lexsort((self._rows[chosen], -self._scores[chosen]))]


class PlaceIndex(Generic[PlaceId]):
    """Stored places by the words they contain, with the dynamic vocabulary.

    The strategies differ only in when the tree is trained again and whether words split. Places are counted in the
    order of arrival, from 0, as in Algorithm 1 of FC-SLAM.
    """

    def __init__(self, config: VocabularyConfig, rng: np.random.Generator) -> None:
        self._config = config
        self.vocabulary = Vocabulary(_shape(config), int(rng.integers(0, 2**63)))
        self.postings = self._no_postings()
        """What the words of the vocabulary hold, by row."""
        self._buffers = empty_buffers(0)
        self._ids: list[PlaceId] = []
        """Identifier of each row; that of a forgotten place stays until the index is compacted."""
        self._row_of: dict[PlaceId, int] = {}
        self._places_seen = 0
        self._trained_on: int | None = None

    def __len__(self) -> int:
        return len(self._row_of)

    def __contains__(self, place: PlaceId) -> bool:
        return place in self._row_of

    @property
    def word_count(self) -> int:
        """Number of words; 0 before the first training."""
        return self.vocabulary.word_count if self._trained_on is not None else 0

    @property
    def version(self) -> int:
        """Number of changes of the vocabulary; 0 before the first training."""
        return self.vocabulary.version

    @property
    def trained_on(self) -> int | None:
        """Number of places that the vocabulary was trained on last; None before the first training."""
        return self._trained_on

    def add(self, place: PlaceId, descriptors: Codes) -> None:
        """Store a place with its descriptors (N, 32): Algorithm 1, lines 3-11."""
        if place in self._row_of:
            raise ValueError(f"place {place} is in the index already")
        codes = code_words(descriptors)
        leaves = self.vocabulary.leaves(codes)
        self._row_of[place] = self.postings.add(codes, leaves)
        self._ids.append(place)
        i = self._places_seen
        self._places_seen += 1
        if self._is_due(i):  # lines 5-9, whose two cases are one window here: D_max(0, i - C + 1) ... D_i
            rows = self._rows()[-self._config.capacity :]
            self._train(self.postings.gather(rows), len(rows))
        elif self._trained_on is not None and self._config.strategy is Strategy.INCREMENTAL:
            self._split(self._overfull(leaves))

    def query(
        self, descriptors: Codes, top_k: int, exclude: Container[PlaceId] = frozenset()
    ) -> list[tuple[PlaceId, float]]:
        """Return the ``top_k`` stored places most similar to these descriptors (N, 32), the most similar first."""
        return self.compare(descriptors).best(top_k, lambda place: place not in exclude)

    def compare(self, descriptors: Codes) -> QueryResult[PlaceId]:
        """Score all stored places against these descriptors (N, 32); empty before the first training."""
        codes = code_words(descriptors)
        entries, count = self.postings.entries, len(self)
        if self._trained_on is None or not count:
            return QueryResult()
        if self.postings.row_count > len(self._buffers.scores):
            self._buffers = empty_buffers(int(GROWTH_FACTOR * self.postings.row_count))
        if self._config.scoring is Scoring.MATCHES:
            tree, beam = self.vocabulary.tree, self._config.beam
            rows, scores = score_matches(entries, tree, self._buffers, count, codes, beam)
        else:
            leaves, weights = self._weigh(codes)
            rows, scores = score_words(entries, self._buffers, count, leaves, weights)
        return QueryResult(self._ids, rows, scores)

    def bag(self, descriptors: Codes) -> BagOfWords:
        """Bag of words of descriptors (N, 32) in the present vocabulary, weighted as stored places are."""
        leaves, weights = self._weigh(code_words(descriptors))
        words = self.vocabulary.words[leaves]
        order = np.argsort(words)
        return BagOfWords(words[order], weights[order], self.version)

    def descriptors(self, place: PlaceId) -> Codes:
        """The descriptors of a stored place, shape (N, 32)."""
        return frozen(self.postings.codes(self._row_of[place]).view(np.uint8), np.uint8)

    def all_descriptors(self) -> Codes:
        """The descriptors of all stored places, in the order in which these were added, shape (M, 32)."""
        return self.postings.gather(self._rows()).view(np.uint8)

    def forget(self, place: PlaceId) -> None:
        """Remove a place."""
        leaves = self.postings.forget(self._row_of.pop(place))
        if self._trained_on is not None and self._config.strategy is Strategy.INCREMENTAL:
            self._merge(leaves)
        if self.postings.row_count > 2 * (len(self) + 1):  # rows of forgotten places go
            self._describe_again(self.postings.gather(self._rows()))

    def train(self, places: Sequence[Codes]) -> None:
        """Train the tree now on the descriptors of these places, each (N, 32), which need not be stored."""
        self._train(np.concatenate([_NO_CODES, *map(code_words, places)]), len(places))

    def state(self) -> State:
        """The state without what the stored places hold, from which ``restored`` makes an equal index."""
        rows = self._rows()
        tree, number_of = self.vocabulary.state()
        leaves = np.concatenate([np.empty(0, np.int32), *map(self.postings.leaves, rows.tolist())])
        return {
            "size": len(self),
            "trained_on": self._trained_on,
            "places_seen": self._places_seen,
            **tree,
            "leaves": number_of[leaves],
            "norms": self.postings.entries.log_documents[rows] if self._config.scoring is Scoring.WORDS else None,
        }

    @classmethod
    def restored(
        cls, config: VocabularyConfig, state: State, ids: Sequence[PlaceId], descriptors: Sequence[Codes]
    ) -> Self:
        """Restore an index from its ``state``; it behaves exactly like the original.

        ``ids``: of the stored places, in the order in which they were added; ``descriptors``: of each, shape (N, 32).
        """
        index = cls(config, np.random.default_rng(0))
        index._trained_on = state["trained_on"]
        index._places_seen = state["places_seen"]
        index.vocabulary = Vocabulary.restored(_shape(config), state)
        index.postings = index._no_postings()
        counts = np.array([len(each) for each in descriptors], np.int32)
        index.postings.fill(np.concatenate([_NO_CODES, *map(code_words, descriptors)]), state["leaves"], counts)
        if state["norms"] is not None:  # their rounding depends on their history
            index.postings.entries.log_documents[: len(counts)] = state["norms"]
        index._ids = list(ids)
        index._row_of = {place: row for row, place in enumerate(index._ids)}
        return index

    def _is_due(self, i: int) -> bool:
        """Algorithm 1, line 4: whether the tree is trained after place i."""
        first = self._config.train_batch + 1
        match self._config.strategy:
            case Strategy.REBUILD:
                return i >= first
            case Strategy.WINDOWED:
                return (i + 1) % (first + 1) == 0
            case Strategy.INCREMENTAL:
                return i >= first and self._trained_on is None

    def _train(self, codes: CodeWords, places: int) -> None:
        """Algorithm 1, line 11: train V_t and describe all stored places in its words."""
        stored = self.postings.gather(self._rows())
        self.vocabulary.train(codes)
        self._trained_on = places
        self._describe_again(stored)
        if self._config.strategy is Strategy.INCREMENTAL:
            self._split(np.flatnonzero(self.postings.entries.sizes > self._config.leaf_capacity))

    def _describe_again(self, stored: CodeWords) -> None:
        """Rebuild the postings from the codes of all stored places, ``stored`` (M, 4), without unused rows."""
        counts = self.postings.entries.counts[self._rows()]
        self.postings = self._no_postings()
        self.postings.fill(stored, self.vocabulary.leaves(stored), counts)
        self._ids = list(self._row_of)
        self._row_of = {place: row for row, place in enumerate(self._ids)}

    def _no_postings(self) -> Postings:
        """Empty postings for the leaves of the present tree."""
        return Postings(self.vocabulary.vertex_count, has_norms=self._config.scoring is Scoring.WORDS)

    def _rows(self) -> NDArray[np.int64]:
        """Rows of the stored places, ascending, shape (P,)."""
        return np.fromiter(self._row_of.values(), np.int64, len(self))

    def _overfull(self, entered: NDArray[np.int32]) -> NDArray[np.int32]:
        """Leaves that just exceeded 1, 2, 4 ... times their capacity.

        A word of equal descriptors cannot be split. Doubling the limit avoids a new attempt at every descriptor.
        """
        capacity, sizes = self._config.leaf_capacity, self.postings.entries.sizes
        leaves, added = np.unique(entered[sizes[entered] > capacity], return_counts=True)
        after = sizes[leaves]
        limit = capacity * 2.0 ** np.floor(np.log2((after - 1) / capacity))
        return leaves[after - added <= limit]

    def _split(self, overfull: NDArray[np.integer[Any]]) -> None:
        """Split words with too many descriptors until none is too large."""
        waiting = sorted(overfull.tolist(), key=self._word, reverse=True)
        while waiting:
            leaf = waiting.pop()
            content = self.postings.content((leaf,))
            targets = self.vocabulary.split(leaf, content.codes)
            if targets is None:
                continue
            self.postings.grow_vertices(self.vocabulary.vertex_count)
            self.postings.move((leaf,), content, targets)
            sizes = self.postings.entries.sizes
            waiting += [child for child in np.unique(targets).tolist() if sizes[child] > self._config.leaf_capacity]

    def _merge(self, leaves: NDArray[np.int32]) -> None:
        """Merge nearly empty words with their siblings, level by level."""
        while len(leaves):
            above = np.unique(self.vocabulary.parents[leaves])
            nearly_empty = [vertex for vertex in above.tolist() if self._is_nearly_empty(vertex)]
            for vertex in sorted(nearly_empty, key=lambda v: self._word(self.vocabulary.children(v).start)):
                children = self.vocabulary.children(vertex)
                content = self.postings.content(range(children.start, children.stop))
                targets = np.full(len(content.rows), vertex, np.int32)
                self.postings.move(range(children.start, children.stop), content, targets)
                self.vocabulary.merge(vertex)
            leaves = np.array(nearly_empty, np.int32)

    def _is_nearly_empty(self, vertex: int) -> bool:
        """Whether the children of a vertex are leaves whose descriptors fit into one word."""
        if vertex < 0:
            return False
        children = self.vocabulary.children(vertex)
        if self.vocabulary.tree.child_count[children].any():
            return False
        return bool(self.postings.entries.sizes[children].sum() <= self._config.leaf_capacity // _MERGED_SHARE)

    def _word(self, leaf: int) -> int:
        """Number of a leaf's word; unlike vertex numbers, it does not depend on the layout in memory."""
        return int(self.vocabulary.words[leaf])

    def _weigh(self, codes: CodeWords) -> tuple[NDArray[np.int32], FloatArray]:
        """Distinct leaves (K,) and their tf-idf (K,), L1 norm 1. Words of all or of no places have weight 0 and go."""
        leaves, counts = np.unique(self.vocabulary.leaves(codes), return_counts=True)
        documents = self.postings.entries.documents[leaves]
        weights = counts * np.log(max(len(self), 1) / np.maximum(documents, 1))
        telling = weights > 0.0
        values: FloatArray = weights[telling] / max(weights.sum(), TINY)
        return leaves[telling], values


def _shape(config: VocabularyConfig) -> TreeShape:
    """Limits of the tree. The leaf capacity is the only limit of a tree whose leaves split."""
    if config.strategy is not Strategy.INCREMENTAL:
        return config.tree.shape
    return config.tree.shape._replace(depth=_MOST_LEVELS, smallest_split=config.leaf_capacity + 1)
