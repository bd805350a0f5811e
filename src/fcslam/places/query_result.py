"""The similarities of all places of an index to one query, scored once and read in several ways."""

from collections.abc import Callable, Sequence
from typing import Generic, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from fcslam.records import FloatArray

PlaceId = TypeVar("PlaceId")

_NO_ROWS, _NO_SCORES = np.empty(0, np.int32), np.empty(0)


class ScoredPlace(NamedTuple, Generic[PlaceId]):
    """A stored place and its similarity to the query."""

    id: PlaceId
    similarity: float
    """In [0, 1], by the measure that ``VocabularyConfig.scoring`` names."""


class QueryResult(Generic[PlaceId]):
    """Similarities of the stored places to one query. Valid until the index changes."""

    def __init__(
        self,
        ids: Sequence[PlaceId] = (),
        rows: NDArray[np.int32] = _NO_ROWS,
        scores: FloatArray = _NO_SCORES,
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

    def best(self, top_k: int, wanted: Callable[[PlaceId], bool] = lambda _: True) -> list[ScoredPlace[PlaceId]]:
        """Return up to ``top_k`` places for which ``wanted`` holds, the most similar first.

        Ties are broken by the order of storage. A place that has nothing in common with the query is never returned.
        """
        found: list[ScoredPlace[PlaceId]] = []
        looked_at, count = 0, 2 * top_k + 16
        while looked_at < len(self._rows) and len(found) < top_k:
            order = self._order(count)
            for position in order[looked_at:]:
                place = self._ids[self._rows[position]]
                if wanted(place):
                    found.append(ScoredPlace(place, float(self._scores[position])))
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
