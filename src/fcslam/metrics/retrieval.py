"""How well similarities between queries and a gallery find the same place again.

The words are those of the tutorial of Schubert et al. 2023 (stschubert/VPR_Tutorial). A similarity matrix has shape
(Q, G); a similarity of 0 or less retrieves nothing. Of every pair the truth says that it is a match, that it is
different, or nothing: then it is ignored, whatever its similarity.

Ties are nobody's luck: where equals compete for a rank, a measure is its mean over all orders of them, and a threshold
takes them all or none.
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
    """What is known of queries (rows) and gallery (columns)."""

    matches: Pairs
    """The same place."""
    different: Pairs
    """Another place; what is neither is ignored."""

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
        """The truth of those queries."""
        return PairTruth(self.matches[queries], self.different[queries])


@dataclass(frozen=True, slots=True)
class PrecisionRecall:
    """A curve over all thresholds, the strictest first."""

    thresholds: FloatArray
    """Shape (T,), falling: what is at least so similar is said to be the same place."""
    precision: FloatArray
    recall: FloatArray

    @property
    def average_precision(self) -> float:
        """Area under the steps: the sum of precision times gain of recall; NaN if there is nothing to find."""
        if np.isnan(self.recall).any():
            return float("nan")
        return float(np.sum(np.diff(self.recall, prepend=0.0) * self.precision))

    @property
    def recall_at_full_precision(self) -> float:
        """The largest recall before the first wrong answer; NaN if there is nothing to find."""
        if np.isnan(self.recall).any():
            return float("nan")
        return float(np.max(self.recall[self.precision >= 1.0], initial=0.0))


def recall_at(similarity: FloatArray, truth: PairTruth, k: int) -> FloatArray:
    """Whether a match is among the ``k`` most similar, for every query that has one, shape (answerable,), in [0, 1].

    Between 0 and 1 where equals compete for the last of the ``k`` ranks. Queries without a match are left out.
    """
    return np.array(
        [_found_within(similarity[q], truth, int(q), k) for q in np.flatnonzero(truth.answerable)], np.float64
    )


@dataclass(frozen=True, slots=True)
class RetrievedPlaces:
    """What every query says at most once: its most similar place."""

    scores: FloatArray
    """Shape (Q,); 0 where nothing is retrieved."""
    right: FloatArray
    """Shape (Q,), in [0, 1]: of equally similar places, the share of matches."""
    answerable: NDArray[np.bool_]
    """Shape (Q,)."""

    def curve(self, queries: NDArray[np.int64] | slice = slice(None)) -> PrecisionRecall:
        """Over the thresholds, for some of the queries; each may be there several times.

        Precision: share of right answers; recall: right answers among the queries that have a match. A query without
        one can only be wrong.
        """
        scores, right = self.scores[queries], self.right[queries]
        given = scores > 0.0
        return _curve(scores[given], right[given], int(self.answerable[queries].sum()))


def single_best(similarity: FloatArray, truth: PairTruth) -> RetrievedPlaces:
    """The most similar place of every query, ignored pairs left out."""
    best = _best(similarity, truth.matches | truth.different)
    first = (similarity == best[:, None]) & (similarity > 0.0)
    right, wrong = ((first & of).sum(axis=1) for of in (truth.matches, truth.different))
    return RetrievedPlaces(best, right / np.maximum(right + wrong, 1), truth.answerable)


def multi_match_curve(similarity: FloatArray, truth: PairTruth) -> PrecisionRecall:
    """Every pair is an answer of its own: all matches are to be found."""
    counted = (truth.matches | truth.different) & (similarity > 0.0)
    return _curve(similarity[counted], truth.matches[counted].astype(np.float64), int(truth.matches.sum()))


def significance(similarity: FloatArray, truth: PairTruth) -> FloatArray:
    """By how much the most similar match is ahead of the most similar wrong place (FC-SLAM, IV.C).

    Shape (answerable,), of the queries that have a match; negative similarities count as 0.
    """
    best = _best(similarity, truth.matches) - _best(similarity, truth.different)
    ahead: FloatArray = best[truth.answerable]
    return ahead


def relative_significance(similarity: FloatArray, truth: PairTruth) -> FloatArray:
    """``significance`` as a share of the similarity of the match, shape (answerable,), at most 1.

    The scale of the similarity drops out, which a larger vocabulary lowers. Where the match has no similarity, -1.
    """
    right = _best(similarity, truth.matches)[truth.answerable]
    ahead = significance(similarity, truth)
    return np.maximum(np.divide(ahead, right, out=np.full_like(ahead, -1.0), where=right > 0.0), -1.0)


def mismatches(similarity: FloatArray, truth: PairTruth) -> FloatArray:
    """1 for each query that has a match but no positive significance, else 0; shape (answerable,)."""
    return (significance(similarity, truth) <= 0.0).astype(np.float64)


def _best(similarity: FloatArray, among: Pairs) -> FloatArray:
    """The highest similarity of every query, 0 without any, shape (Q,)."""
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
    """From answers with their scores and how right they are, each in [0, 1]."""
    order = np.argsort(-scores, kind="stable")
    scores, right = scores[order], right[order]
    last = np.flatnonzero(np.diff(scores, append=-np.inf))
    found = np.cumsum(right)[last]
    recall = found / to_find if to_find else np.full(len(last), np.nan)
    return PrecisionRecall(scores[last], found / (last + 1.0), recall)
