"""Bags of words and their similarity (eq. (4) of FC-SLAM).

The place at time k is Z_k = {z_1 ... z_N}, z_i the tf-idf of word i (FC-SLAM, III.B). fcslam divides it by its L1 norm;
without that, a threshold on the similarity would have no meaning.

These functions compare two places, and are what the compiled score is tested against. The index compares a query with
all stored places at once, by ``score_words`` or ``score_matches`` in ``fcslam.places.scoring``.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fcslam.records import FloatArray

PAPER_SCALE = 4.0
"""``paper_similarity`` of a place with itself; the paper's threshold 0.85 is 0.2125 on the scale of ``similarity``."""


@dataclass(frozen=True, slots=True)
class BagOfWords:
    """tf-idf vector of one place, sparse, L1 norm 1; empty if no word has a positive weight."""

    words: NDArray[np.int64]
    """Shape (K,), ascending."""
    values: FloatArray
    """Shape (K,), positive."""
    vocabulary_version: int


def similarity(x: BagOfWords, y: BagOfWords) -> float:
    """L1 score 1 - |x - y|_1 / 2 = sum of min(x_i, y_i), in [0, 1]: a quarter of ``paper_similarity``."""
    values_x, values_y = _common(x, y)
    return float(np.minimum(values_x, values_y).sum())


def paper_similarity(x: BagOfWords, y: BagOfWords) -> float:
    """Equation (4) of FC-SLAM as printed, in [0, 4]: four times ``similarity``.

    The sum runs over the common words, because any other word adds |z| + 0 - |z| = 0.
    """
    values_x, values_y = _common(x, y)
    return float(2.0 * np.sum(np.abs(values_x) + np.abs(values_y) - np.abs(values_x - values_y)))  # eq. (4)


def _common(x: BagOfWords, y: BagOfWords) -> tuple[FloatArray, FloatArray]:
    if x.vocabulary_version != y.vocabulary_version:
        raise ValueError(f"words of vocabulary {x.vocabulary_version} and {y.vocabulary_version} cannot be compared")
    _, index_x, index_y = np.intersect1d(x.words, y.words, assume_unique=True, return_indices=True)
    return x.values[index_x], y.values[index_y]
