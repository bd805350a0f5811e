"""Place matching in the cloud: a place comes in, out comes M_ij (Algorithm 1), decided by geometry.

Words propose while the fleet is large, every place does while it is small, and where two robots already share a map,
nearness does. A proposal is a rigid motion; the submaps laid on each other by it decide.
"""

import heapq
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from pydantic import Field

from fcslam.config import Settings
from fcslam.features.codes import mutual_matches
from fcslam.lidar.submap import Submap
from fcslam.lidar.verification import Verification, VerificationConfig, verify
from fcslam.places.hypotheses import HypothesisConfig, propose
from fcslam.places.index import InvertedIndex
from fcslam.places.vocabulary import DynamicVocabulary, DynamicVocabularyConfig
from fcslam.records import FloatArray, KeyscanId, Place


class MatcherConfig(Settings):
    """Place matching."""

    small_fleet: int = Field(
        default=150, ge=0, description="up to this many places are all compared; then words choose"
    )
    candidates: int = Field(default=20, gt=0, description="places that words propose for one place")
    hamming_limit: int = Field(default=60, gt=0, le=256, description="most different bits of matching descriptors")
    doubts: int = Field(
        default=2, ge=0, description="places of robots in the same map that are compared wherever the map puts them"
    )
    inliers: int = Field(default=8, ge=4, description="keypoints that must agree before geometry is asked")
    vocabulary: DynamicVocabularyConfig = Field(default=DynamicVocabularyConfig(), description="dynamic vocabulary")
    hypotheses: HypothesisConfig = Field(default=HypothesisConfig(), description="rigid motions from keypoints")
    verification: VerificationConfig = Field(default=VerificationConfig(), description="verification of closures")


@dataclass(frozen=True, slots=True)
class PlaceMatch:
    """Two places compared: i was there before, j is the new one."""

    i: KeyscanId
    j: KeyscanId
    similarity: float
    """Eq. (4) on the scale of [0, 1]; the share of matching descriptors before the first vocabulary."""
    check: Verification
    predicted: bool
    """Whether the robots shared a map already and the guess came from it."""

    @property
    def M(self) -> bool:
        """The paper's matching flag: the same place."""
        return self.check.loose if self.predicted else self.check.strict


class PlaceMatcher:
    """All places of one channel and detector version, and the vocabulary that follows them."""

    def __init__(self, config: MatcherConfig, submap_of: Callable[[Place], Submap], rng: np.random.Generator) -> None:
        self._config = config
        self._submap_of = submap_of
        self._places: dict[KeyscanId, Place] = {}
        self._dynamic = DynamicVocabulary(config.vocabulary, rng)
        self._index: InvertedIndex[KeyscanId] | None = None
        self._backlog: list[Place] = []
        self._undescribed: list[Place] = []

    def __len__(self) -> int:
        return len(self._places)

    def match(
        self, place: Place, predicted: Mapping[KeyscanId, FloatArray], strangers: Callable[[KeyscanId], bool]
    ) -> list[PlaceMatch]:
        """Compare a new place with those that may be the same, then store it.

        ``predicted``: T_i_j of stored places i that the joint map says are near; ``strangers``: whether a stored
        place belongs to a robot whose relative pose is not known yet.
        """
        comparable = bool(predicted) or any(strangers(i) for i in self._places)
        similarity = self._similarities(place) if comparable else {}  # Algorithm 1, lines 11-13
        matches = [self._near_match(i, place, T_i_j, similarity) for i, T_i_j in predicted.items()]
        doubtful = self._doubtful(place.id.robot, similarity, predicted, strangers)
        matches += [
            match
            for i in (*self._candidates(similarity, strangers), *doubtful)
            if (match := self._far_match(i, place, similarity)) is not None
        ]
        self._places[place.id] = place
        self._backlog.append(place)
        return matches

    def _similarities(self, place: Place) -> dict[KeyscanId, float]:
        for stored in self._backlog:  # a robot alone never needs its words
            self._describe(stored)
        self._backlog.clear()
        if self._index is None:
            return {}
        return dict(self._index.query(place.descriptors, top_k=len(self._index)))

    def _candidates(
        self, similarity: Mapping[KeyscanId, float], strangers: Callable[[KeyscanId], bool]
    ) -> list[KeyscanId]:
        """Every stranger's place while there are few, else those that share most words."""
        eligible = [i for i in self._places if strangers(i)]
        if len(eligible) <= self._config.small_fleet or not similarity:
            return eligible
        return sorted(eligible, key=lambda i: -similarity.get(i, 0.0))[: self._config.candidates]

    def _doubtful(
        self,
        robot: str,
        similarity: Mapping[KeyscanId, float],
        predicted: Mapping[KeyscanId, FloatArray],
        strangers: Callable[[KeyscanId], bool],
    ) -> list[KeyscanId]:
        """Places of robots in the same map that look most alike without lying near: the map may be wrong."""
        known = (i for i in similarity if i.robot != robot and i not in predicted and not strangers(i))
        return heapq.nlargest(self._config.doubts, known, key=lambda i: similarity[i])

    def _near_match(
        self, i: KeyscanId, place: Place, T_i_j: FloatArray, similarity: Mapping[KeyscanId, float]
    ) -> PlaceMatch:
        check = verify(self._submap_of(self._places[i]), self._submap_of(place), T_i_j, self._config.verification)
        return PlaceMatch(i, place.id, similarity.get(i, 0.0), check, predicted=True)

    def _far_match(self, i: KeyscanId, place: Place, similarity: Mapping[KeyscanId, float]) -> PlaceMatch | None:
        """Verify the motions that the keypoints propose; the most convincing one, None if there is none."""
        stored = self._places[i]
        matches = mutual_matches(stored.descriptors, place.descriptors, self._config.hamming_limit)
        proposed = propose(stored.keypoints, place.keypoints, matches, self._config.hypotheses)
        proposed = [h for h in proposed if h.inlier_count >= self._config.inliers]
        if not proposed:
            return None
        a, b = self._submap_of(stored), self._submap_of(place)
        checks = [verify(a, b, h.T_a_b, self._config.verification) for h in proposed]
        best = max(checks, key=lambda check: (check.strict, check.worse.explained - check.worse.violation))
        share = len(matches.pairs) / max(1, min(len(stored.descriptors), len(place.descriptors)))
        return PlaceMatch(i, place.id, similarity.get(i, share), best, predicted=False)

    def _describe(self, place: Place) -> None:
        """Algorithm 1, lines 3-11: the place joins the vocabulary's window, and the index in its words."""
        retrained = self._dynamic.add(place.descriptors)
        vocabulary = self._dynamic.vocabulary
        if vocabulary is None:
            self._undescribed.append(place)
            return
        if self._index is None:
            self._index = InvertedIndex(vocabulary)
            for earlier in self._undescribed:
                self._index.add(earlier.id, earlier.descriptors)
            self._undescribed.clear()
        elif retrained:
            self._index.describe_again(vocabulary)
        self._index.add(place.id, place.descriptors)
