"""Place retrieval metrics on similarities between queries and a gallery.

The terms are those of the tutorial of Schubert et al. 2023 (stschubert/VPR_Tutorial). A similarity matrix has shape
(Q, G); a similarity of 0 or less retrieves nothing. The ground truth labels a pair as a match, as different, or not at
all; unlabelled pairs are ignored.

Ties do not depend on the order: a ranking measure is the mean over all orders of equal similarities, and a threshold
accepts all of them or none.
"""

from dataclasses import dataclass
from math import comb

import numpy as np
from numpy.typing import NDArray

from fcslam.records import FloatArray

Pairs = NDArray[np.bool_]
"""Shape (Q, G)."""


@dataclass(frozen=True, slots=True)
class PairTruth:
    """Ground truth of pairs of queries (rows) and gallery places (columns)."""

    matches: Pairs
    """Pairs of the same place, shape (Q, G)."""
    different: Pairs
    """Pairs of different places, shape (Q, G); pairs that are neither are ignored."""

    def __post_init__(self) -> None:
        if self.matches.shape != self.different.shape or self.matches.ndim != 2:
            raise ValueError(f"matches {self.matches.shape} and different {self.different.shape} must be (Q, G) both")
        if (self.matches & self.different).any():
            raise ValueError("a pair cannot match and be different")

    @property
    def answerable(self) -> NDArray[np.bool_]:
        """Queries that have a match, shape (Q,)."""
        return np.asarray(self.matches.any(axis=1), np.bool_)

    def take(self, queries: NDArray[np.int64] | NDArray[np.bool_]) -> "PairTruth":
        """The ground truth of some queries: indices (K,) or a mask (Q,)."""
        return PairTruth(self.matches[queries], self.different[queries])


@dataclass(frozen=True, slots=True)
class PrecisionRecall:
    """A precision-recall curve, the strictest threshold first."""

    thresholds: FloatArray
    """Shape (T,), descending: similarities from which a pair is accepted."""
    precision: FloatArray
    """Shape (T,)."""
    recall: FloatArray
    """Shape (T,); NaN if there is nothing to find."""

    @property
    def average_precision(self) -> float:
        """Average precision: the sum of precision times gain of recall; NaN if there is nothing to find."""
        if np.isnan(self.recall).any():
            return float("nan")
        return float(np.sum(np.diff(self.recall, prepend=0.0) * self.precision))

    @property
    def recall_at_full_precision(self) -> float:
        """Maximum recall at 100 % precision; NaN if there is nothing to find."""
        if np.isnan(self.recall).any():
            return float("nan")
        return float(np.max(self.recall[self.precision >= 1.0], initial=0.0))


def recall_at(similarity: FloatArray, truth: PairTruth, k: int) -> FloatArray:
    """Recall@k of every query that has a match, shape (answerable,), in [0, 1].

    It is 1 if a match is among the ``k`` most similar places, and a probability in between if ties decide. Queries
    without a match are excluded. ``similarity``: shape (Q, G).
    """
    return np.array(
        [_found_within(similarity[q], truth, int(q), k) for q in np.flatnonzero(truth.answerable)], np.float64
    )


@dataclass(frozen=True, slots=True)
class RetrievedPlaces:
    """The single best match of every query."""

    scores: FloatArray
    """Similarity of the retrieved place, shape (Q,); 0 if none is retrieved."""
    right: FloatArray
    """Whether it is a match, shape (Q,); of equally similar places, the share of matches."""
    answerable: NDArray[np.bool_]
    """Whether the query has a match, shape (Q,)."""

    def curve(self, queries: NDArray[np.int64] | slice = slice(None)) -> PrecisionRecall:
        """Precision-recall curve of some queries, indices (K,) that may repeat.

        Precision is the share of correct retrievals. Recall is the number of correct retrievals divided by the number
        of queries that have a match. Any retrieval of a query without a match is wrong.
        """
        scores, right = self.scores[queries], self.right[queries]
        given = scores > 0.0
        return _curve(scores[given], right[given], int(self.answerable[queries].sum()))


def single_best(similarity: FloatArray, truth: PairTruth) -> RetrievedPlaces:
    """Retrieve the most similar place of every query from similarities (Q, G), without ignored pairs."""
    best = _best(similarity, truth.matches | truth.different)
    first = (similarity == best[:, None]) & (similarity > 0.0)
    right, wrong = ((first & of).sum(axis=1) for of in (truth.matches, truth.different))
    return RetrievedPlaces(best, right / np.maximum(right + wrong, 1), truth.answerable)


def multi_match_curve(similarity: FloatArray, truth: PairTruth) -> PrecisionRecall:
    """Precision-recall curve over all pairs (multi-match) of similarities (Q, G): all matches are to be found."""
    counted = (truth.matches | truth.different) & (similarity > 0.0)
    return _curve(similarity[counted], truth.matches[counted].astype(np.float64), int(truth.matches.sum()))


def significance(similarity: FloatArray, truth: PairTruth) -> FloatArray:
    """Similarity of the best match minus that of the best wrong place (FC-SLAM, IV.C), from similarities (Q, G).

    Shape (answerable,), for the queries that have a match; negative similarities count as 0.
    """
    best = _best(similarity, truth.matches) - _best(similarity, truth.different)
    ahead: FloatArray = best[truth.answerable]
    return ahead


def relative_significance(similarity: FloatArray, truth: PairTruth) -> FloatArray:
    """``significance`` divided by the similarity of the match, shape (answerable,), in [-1, 1].

    It does not depend on the scale of similarities (Q, G), which a larger vocabulary lowers. It is -1 if the match has
    similarity 0.
    """
    right = _best(similarity, truth.matches)[truth.answerable]
    ahead = significance(similarity, truth)
    return np.maximum(np.divide(ahead, right, out=np.full_like(ahead, -1.0), where=right > 0.0), -1.0)


def mismatches(similarity: FloatArray, truth: PairTruth) -> FloatArray:
    """1 for each query whose match has no positive significance, else 0; shape (answerable,), from (Q, G)."""
    return (significance(similarity, truth) <= 0.0).astype(np.float64)


def _best(similarity: FloatArray, among: Pairs) -> FloatArray:
    """The highest similarity of every query among some pairs (Q, G), at least 0, shape (Q,)."""
    best: FloatArray = np.max(np.where(among, similarity, 0.0), axis=1, initial=0.0)
    return best


def _found_within(row: FloatArray, truth: PairTruth, query: int, k: int) -> float:
    right, wrong = row[truth.matches[query]], row[truth.different[query]]
    best = right.max()
    if best <= 0.0:
        return 0.0
    ranks = k - int((wrong > best).sum())
    if ranks <= 0:
        return 0.0
    rivals, equals = int((wrong == best).sum()), int((right == best).sum())
    return 1.0 - comb(rivals, ranks) / comb(rivals + equals, ranks) if ranks <= rivals else 1.0


def _curve(scores: FloatArray, right: FloatArray, to_find: int) -> PrecisionRecall:
    """Curve of retrievals with their scores (N,) and correctness (N,) in [0, 1], for ``to_find`` matches."""
    order = np.argsort(-scores, kind="stable")
    scores, right = scores[order], right[order]
    last = np.flatnonzero(np.diff(scores, append=-np.inf))
    found = np.cumsum(right)[last]
    recall = found / to_find if to_find else np.full(len(last), np.nan)
    return PrecisionRecall(scores[last], found / (last + 1.0), recall)


def excluding_recent(stamps: NDArray[np.int64] | FloatArray, gap: float) -> NDArray[np.bool_]:
    """Mask of the places (columns) that a query (row) may retrieve: those at least ``gap`` before it, shape (N, N).

    A place is always similar to those just before it, so retrieving them is not a loop. ``stamps`` (N,) ascend: times,
    or numbers of places.
    """
    return np.asarray((stamps[:, None] - stamps >= gap) & np.tri(len(stamps), k=-1, dtype=np.bool_))
