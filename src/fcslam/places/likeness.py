"""How alike the places of an index are to one query: one scoring, several questions."""

from collections.abc import Callable, Sequence
from typing import Generic, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from fcslam.records import FloatArray

PlaceId = TypeVar("PlaceId")

_NO_ROWS, _NO_SCORES = np.empty(0, np.int32), np.empty(0)


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
