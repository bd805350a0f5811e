"""Geometric verification of pairs of places by their matching features."""

from typing import Final

import cv2
import numpy as np

from fcslam.features.codes import hamming_matrix
from fcslam.features.matching import mutual_pairs
from fcslam.lab.evaluation.places.scoring import DescribedSet, PlaceFeatures
from fcslam.records import FloatArray

RATIO: Final = 0.9
"""Ratio test (Lowe 2004): largest ratio of the nearest to the second nearest distance."""
ACCEPTED_INLIERS: Final = 20
"""Inliers at which the verified similarity is 0.5."""
CANDIDATES: Final = 50
"""Most similar places of a query that are verified."""
_EPIPOLAR_PX = 1.5
"""Largest epipolar error of an inlier."""
_FEWEST = 8
"""Fewest matches for a fundamental matrix."""
_TRIALS = 1000
"""Most iterations of MAGSAC++."""
_CONFIDENCE = 0.999


class PairVerifier:
    """Verifies pairs of a set and caches the results."""

    def __init__(self, described: DescribedSet) -> None:
        self._described = described
        self._inliers: dict[tuple[int, int], int] = {}

    def verified(self, similarity: FloatArray) -> FloatArray:
        """Verified similarity inliers / (inliers + 20) of the most similar places of every query, else 0: shape (Q, G).

        A pair with at least 0.5 is accepted.
        """
        verified = np.zeros(similarity.shape)
        for q, row in enumerate(similarity):
            best = np.argsort(-row, kind="stable")[:CANDIDATES]
            for g in best[row[best] > 0.0]:
                inliers = self.inliers(q, int(g))
                verified[q, g] = inliers / (inliers + ACCEPTED_INLIERS)
        return verified

    def inliers(self, query: int, place: int) -> int:
        """Number of inliers of a pair."""
        if (query, place) not in self._inliers:
            pair = self._described.queries[query], self._described.gallery[place]
            self._inliers[query, place] = self._described.count_inliers(*pair)
        return self._inliers[query, place]


def epipolar_inliers(a: PlaceFeatures, b: PlaceFeatures) -> int:
    """Number of inliers of the fundamental matrix between two images; it also covers planar scenes."""
    first, second = distinct_matches(a, b)
    if len(first) < _FEWEST:
        return 0
    cv2.setRNGSeed(0)
    try:
        _, mask = cv2.findFundamentalMat(first, second, cv2.USAC_MAGSAC, _EPIPOLAR_PX, _CONFIDENCE, _TRIALS)
    except cv2.error:  # no model, for example for matches on a line
        return 0
    return 0 if mask is None else int(mask.sum())


def distinct_matches(a: PlaceFeatures, b: PlaceFeatures) -> tuple[FloatArray, FloatArray]:
    """Positions of mutual nearest neighbours that pass the ratio test, pixels, shape (K, 2) each."""
    if min(len(a.descriptors), len(b.descriptors)) < 2:
        return np.empty((0, 2)), np.empty((0, 2))
    distances = hamming_matrix(a.descriptors, b.descriptors)
    pairs = mutual_pairs(distances.argmin(axis=1), distances.argmin(axis=0))
    nearest = np.partition(distances[pairs[:, 0]], 1, axis=1)[:, :2].astype(np.float64)
    kept = pairs[nearest[:, 0] < RATIO * nearest[:, 1]]
    return a.positions[kept[:, 0]].astype(np.float64), b.positions[kept[:, 1]].astype(np.float64)
