"""The places of one robot, so that it recognises where it was before, however far its estimate has drifted."""

from collections.abc import Collection

import numpy as np

from fcslam.features.birdseye import BirdseyeFeatures, describe
from fcslam.features.codes import mutual_matches
from fcslam.places.index import PlaceIndex
from fcslam.places.motions import LARGEST_HAMMING, LEAST_INLIERS, rigid_hypotheses
from fcslam.places.vocabulary import VocabularyConfig
from fcslam.records import FloatArray

VOCABULARY = VocabularyConfig()
"""Vocabulary of the places of one robot."""


class OwnPlaces:
    """The LiDAR places of one session (``lidar.closing.PlaceRecognizer``), with a vocabulary of their own."""

    def __init__(self, vocabulary: VocabularyConfig = VOCABULARY) -> None:
        self._features: dict[int, BirdseyeFeatures] = {}
        self._index: PlaceIndex[int] = PlaceIndex(vocabulary, np.random.default_rng(0))
        self._backlog: list[int] = []
        """Places that the index lacks: a robot whose loops are short never asks it."""

    def store(self, keyscan: int, surface: FloatArray) -> None:
        """Describe and store a submap by the points of its surfaces, shape (N, 2), metres in its anchor's base."""
        self._features[keyscan] = describe(surface)
        self._backlog.append(keyscan)

    def features(self, keyscan: int) -> BirdseyeFeatures:
        """The description of a stored submap."""
        return self._features[keyscan]

    def most_similar(self, keyscan: int, among: Collection[int], most: int) -> list[int]:
        """At most ``most`` of these stored submaps that look like a stored one, the most similar first."""
        for stored in self._backlog:
            self._index.add(stored, self._features[stored].descriptors)
        self._backlog.clear()
        result = self._index.compare(self._features[keyscan].descriptors)
        return [found.id for found in result.best(most, lambda place: place in among)]

    def forget(self, keyscan: int) -> None:
        """Forget a stored submap."""
        del self._features[keyscan]
        if keyscan in self._index:
            self._index.forget(keyscan)
        else:
            self._backlog.remove(keyscan)

    def motions(self, a: int, b: int) -> list[FloatArray]:
        """Motions ``T_a_b``, shape (3,), that enough keypoints of two stored submaps support, the best first."""
        of_a, of_b = self._features[a], self._features[b]
        matches = mutual_matches(of_a.descriptors, of_b.descriptors, LARGEST_HAMMING)
        proposed = rigid_hypotheses(of_a.keypoints_m, of_b.keypoints_m, matches)
        return [hypothesis.T_a_b for hypothesis in proposed if hypothesis.inlier_count >= LEAST_INLIERS]
