"""The places of one robot, so that it recognises where it was before, however far its estimate has drifted."""

from collections.abc import Collection
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from fcslam.features.birdseye import BirdseyeFeatures, describe
from fcslam.features.codes import mutual_matches
from fcslam.places.index import PlaceIndex
from fcslam.places.motions import LARGEST_HAMMING, LEAST_INLIERS, rigid_hypotheses
from fcslam.places.vocabulary import VocabularyConfig
from fcslam.records import Codes, FloatArray

VOCABULARY = VocabularyConfig()
"""Vocabulary of the places of one robot."""
READY = 64
"""Places whose descriptors are kept ready: successive submaps are compared with the same ones."""


class OwnPlaces:
    """The LiDAR places of one session (``lidar.closing.PlaceRecognizer``), with a vocabulary of their own."""

    def __init__(self, vocabulary: VocabularyConfig = VOCABULARY) -> None:
        self._keypoints_m: dict[int, NDArray[np.float32]] = {}
        self._index: PlaceIndex[int] = PlaceIndex(vocabulary, np.random.default_rng(0))
        self._descriptors = lru_cache(READY)(self._index.descriptors)
        """Those of a place in the index, which holds each descriptor once."""
        self._waiting: dict[int, Codes] = {}
        """Descriptors of the places that the index lacks: a robot whose loops are short never asks it."""

    def store(self, keyscan: int, surface: FloatArray) -> None:
        """Describe and store a submap by the points of its surfaces, shape (N, 2), metres in its anchor's base."""
        features = describe(surface)
        self._keypoints_m[keyscan], self._waiting[keyscan] = features.keypoints_m, features.descriptors

    def features(self, keyscan: int) -> BirdseyeFeatures:
        """The description of a stored submap."""
        waiting = self._waiting.get(keyscan)
        return BirdseyeFeatures(self._keypoints_m[keyscan], self._descriptors(keyscan) if waiting is None else waiting)

    def most_similar(self, keyscan: int, among: Collection[int], most: int) -> list[int]:
        """At most ``most`` of these stored submaps that look like a stored one, the most similar first."""
        for stored, descriptors in self._waiting.items():
            self._index.add(stored, descriptors)
        self._waiting.clear()
        result = self._index.compare(self._descriptors(keyscan))
        return [found.id for found in result.best(most, lambda place: place in among)]

    def forget(self, keyscan: int) -> None:
        """Forget a stored submap."""
        del self._keypoints_m[keyscan]
        if keyscan in self._index:
            self._index.forget(keyscan)
        else:
            del self._waiting[keyscan]

    def motions(self, a: int, b: int) -> list[FloatArray]:
        """Motions ``T_a_b``, shape (3,), that enough keypoints of two stored submaps support, the best first."""
        of_a, of_b = self.features(a), self.features(b)
        matches = mutual_matches(of_a.descriptors, of_b.descriptors, LARGEST_HAMMING)
        proposed = rigid_hypotheses(of_a.keypoints_m, of_b.keypoints_m, matches)
        return [T_a_b for T_a_b, inliers in proposed if len(inliers) >= LEAST_INLIERS]
