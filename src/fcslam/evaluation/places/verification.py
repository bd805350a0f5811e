"""Whether the images of two places can show the same scene, by where their matching features lie."""

from typing import Final

import cv2
import numpy as np

from fcslam.evaluation.places.scoring import DescribedSet, PlaceFeatures
from fcslam.features.codes import hamming_matrix
from fcslam.features.matching import mutual_pairs
from fcslam.records import FloatArray

RATIO: Final = 0.9
"""A match is kept if the second nearest is farther by this factor at least."""
ACCEPTED_INLIERS: Final = 20
CANDIDATES: Final = 50
"""Places of a query that are checked, the most similar first."""
_EPIPOLAR_PX = 1.5
_FEWEST = 8
_TRIALS = 1000
_CONFIDENCE = 0.999


class PairVerifier:
    """Checks pairs of a set, each once, however many ask."""

    def __init__(self, described: DescribedSet) -> None:
        self._described = described
        self._inliers: dict[tuple[int, int], int] = {}

    def verified(self, similarity: FloatArray) -> FloatArray:
        """inliers / (inliers + 20) of the most similar places of every query, else 0, shape (Q, G): from 0.5 on, a
        pair is accepted."""
        verified = np.zeros(similarity.shape)
        for q, row in enumerate(similarity):
            best = np.argsort(-row, kind="stable")[:CANDIDATES]
            for g in best[row[best] > 0.0]:
                inliers = self.inliers(q, int(g))
                verified[q, g] = inliers / (inliers + ACCEPTED_INLIERS)
        return verified

    def inliers(self, query: int, place: int) -> int:
        """Matches that agree on one scene."""
        if (query, place) not in self._inliers:
            pair = self._described.queries[query], self._described.gallery[place]
            self._inliers[query, place] = self._described.count_inliers(*pair)
        return self._inliers[query, place]


def epipolar_inliers(a: PlaceFeatures, b: PlaceFeatures) -> int:
    """Matches of two images that one fundamental matrix explains; of a plane it explains as many as a homography."""
    first, second = distinct_matches(a, b)
    if len(first) < _FEWEST:
        return 0
    cv2.setRNGSeed(0)
    try:
        _, mask = cv2.findFundamentalMat(first, second, cv2.USAC_MAGSAC, _EPIPOLAR_PX, _CONFIDENCE, _TRIALS)
    except cv2.error:  # of matches on a line, for one: it finds no model
        return 0
    return 0 if mask is None else int(mask.sum())


def distinct_matches(a: PlaceFeatures, b: PlaceFeatures) -> tuple[FloatArray, FloatArray]:
    """Where mutual nearest neighbours are that pass the ratio test, shape (K, 2) twice."""
    if min(len(a.descriptors), len(b.descriptors)) < 2:
        return np.empty((0, 2)), np.empty((0, 2))
    distances = hamming_matrix(a.descriptors, b.descriptors)
    pairs = mutual_pairs(distances.argmin(axis=1), distances.argmin(axis=0))
    nearest = np.partition(distances[pairs[:, 0]], 1, axis=1)[:, :2].astype(np.float64)
    kept = pairs[nearest[:, 0] < RATIO * nearest[:, 1]]
    return a.positions[kept[:, 0]].astype(np.float64), b.positions[kept[:, 1]].astype(np.float64)
