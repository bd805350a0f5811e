"""Place matching in the cloud: a place comes in, out comes M_ij (Algorithm 1), decided by geometry.

Words propose while the fleet is large, every place does while it is small, and where two robots already share a map,
nearness does. A proposal is a rigid motion; the submaps laid on each other by it decide.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from pydantic import Field

from fcslam.config import Settings
from fcslam.geometry import se2
from fcslam.lidar.submap import Submap
from fcslam.lidar.verification import Verification, VerificationConfig, verify
from fcslam.places.index import PlaceIndex
from fcslam.places.likeness import Likeness
from fcslam.places.motions import Motion, MotionConfig, motions
from fcslam.places.vocabulary import VocabularyConfig
from fcslam.records import Channel, FloatArray, KeyscanId, Place


class MatcherConfig(Settings):
    """Place matching."""

    small_fleet: int = Field(
        default=150, ge=0, description="up to this many places are all compared; then words choose"
    )
    candidates: int = Field(default=20, gt=0, description="places that words propose for one place")
    most_places: int = Field(
        default=100_000, gt=0, description="places kept of one channel; of more the oldest are forgotten"
    )
    most_nearby: int = Field(
        default=12, gt=0, description="places kept of one robot and channel in a square; of more the oldest goes"
    )
    nearby_m: float = Field(default=2.0, gt=0.0, description="side of these squares, in a map")
    doubts: int = Field(
        default=2, ge=0, description="places of robots in the same map that are compared wherever the map puts them"
    )
    vocabulary: VocabularyConfig = Field(default=VocabularyConfig(), description="dynamic vocabulary")
    motions: MotionConfig = Field(default=MotionConfig(), description="rigid motions from keypoints")
    borne_out_m: float = Field(default=1.0, gt=0.0, description="images bear out a prediction that is off by no more")
    borne_out_rad: float = Field(default=0.3, gt=0.0, description="and turned by no more")
    verification: VerificationConfig = Field(default=VerificationConfig(), description="verification of closures")


@dataclass(frozen=True, slots=True)
class PlaceMatch:
    """Two places compared: i was there before, j is the new one."""

    i: KeyscanId
    j: KeyscanId
    channel: Channel
    similarity: float
    """In [0, 1], as the index scores; before the first vocabulary the share of matching descriptors, where asked."""
    check: Verification
    predicted: bool
    """Whether the robots shared a map already, which put the places here."""

    @property
    def M(self) -> bool:
        """The paper's matching flag: the same place."""
        return self.check.loose if self.predicted else self.check.strict


class PlaceMatcher:
    """All places of one channel and detector version, and the vocabulary that follows them."""

    def __init__(
        self,
        config: MatcherConfig,
        submap_of: Callable[[Place], Submap],
        rng: np.random.Generator,
        forgotten: Callable[[Place], None] = lambda _: None,
    ) -> None:
        """``forgotten`` is told of every place that is never compared again."""
        self._config = config
        self._submap_of = submap_of
        self._forgotten = forgotten
        self._places: dict[KeyscanId, Place] = {}
        self._index: PlaceIndex[KeyscanId] = PlaceIndex(config.vocabulary, rng)
        self._backlog: list[Place] = []

    def __len__(self) -> int:
        return len(self._places)

    @property
    def word_count(self) -> int:
        """Words of the vocabulary; 0 before it is needed."""
        return self._index.word_count

    def __contains__(self, place: KeyscanId) -> bool:
        return place in self._places

    def __iter__(self) -> Iterator[KeyscanId]:
        """The oldest first."""
        return iter(self._places)

    def match(
        self, place: Place, predicted: Mapping[KeyscanId, FloatArray], strangers: Callable[[KeyscanId], bool]
    ) -> list[PlaceMatch]:
        """Compare a new place with those that may be the same, then store it.

        ``predicted``: T_i_j of stored places i that the joint map says are near; ``strangers``: whether a stored
        place belongs to a robot whose relative pose is not known yet. Forgotten places are left out.
        """
        comparable = bool(predicted) or any(strangers(i) for i in self._places)
        likeness = self._likeness(place) if comparable else Likeness[KeyscanId]()  # Algorithm 1, lines 11-13
        kept = {i: T_i_j for i, T_i_j in predicted.items() if i in self._places}
        near = [self._near_match(i, place, T_i_j, likeness) for i, T_i_j in kept.items()]
        doubtful = self._doubtful(place.id.robot, likeness, predicted, strangers)
        others = (*self._candidates(likeness, strangers), *doubtful)
        far = [self._far_match(i, place, likeness) for i in others]
        self._places[place.id] = place
        self._backlog.append(place)
        self._forget_oldest()
        return [match for match in (*near, *far) if match is not None]

    def _likeness(self, place: Place) -> Likeness[KeyscanId]:
        for stored in self._backlog:  # a robot alone never needs its words
            self._index.add(stored.id, stored.descriptors)
        self._backlog.clear()
        return self._index.compare(place.descriptors)

    def forget(self, place: KeyscanId) -> None:
        """Never compare this place again.

        Raises:
            KeyError: it is not stored.
        """
        gone = self._places.pop(place)
        if place in self._index:
            self._index.forget(place)
        else:
            self._backlog = [stored for stored in self._backlog if stored.id != place]
        self._forgotten(gone)

    def _forget_oldest(self) -> None:
        """Bounds the memory: a fleet that goes on for ever keeps its newest places."""
        while len(self._places) > self._config.most_places:
            self.forget(next(iter(self._places)))

    def _candidates(self, likeness: Likeness[KeyscanId], strangers: Callable[[KeyscanId], bool]) -> list[KeyscanId]:
        """Every stranger's place while there are few, else those that are most alike."""
        eligible = [i for i in self._places if strangers(i)]
        if len(eligible) <= self._config.small_fleet or self._index.training is None:
            return eligible
        return [found.id for found in likeness.best(self._config.candidates, strangers)]

    def _doubtful(
        self,
        robot: str,
        likeness: Likeness[KeyscanId],
        predicted: Mapping[KeyscanId, FloatArray],
        strangers: Callable[[KeyscanId], bool],
    ) -> list[KeyscanId]:
        """Places of robots in the same map that look most alike without lying near: the map may be wrong."""

        def is_known(i: KeyscanId) -> bool:
            return i.robot != robot and i not in predicted and not strangers(i)

        return [found.id for found in likeness.best(self._config.doubts, is_known)]

    def _near_match(
        self, i: KeyscanId, place: Place, T_i_j: FloatArray, likeness: Likeness[KeyscanId]
    ) -> PlaceMatch | None:
        """Verify a prediction. Submaps that are near show the same; images need not, so they have to bear it out.

        Images that show something else instead are compared as if nothing were known: the map may be wrong.
        """
        stored = self._places[i]
        if place.channel is Channel.LIDAR:
            check = verify(self._submap_of(stored), self._submap_of(place), T_i_j, self._config.verification)
            return PlaceMatch(i, place.id, place.channel, likeness.of(i), check, predicted=True)
        proposed = motions(stored, place, self._config.motions)
        motion = next((motion for motion in proposed if self._bears_out(motion, T_i_j)), None)
        if motion is None:
            return self._best(stored, place, proposed, likeness)
        check = self._verify(stored, place, motion)
        return PlaceMatch(i, place.id, place.channel, likeness.of(i, motion.share), check, predicted=True)

    def _bears_out(self, motion: Motion, T_i_j: FloatArray) -> bool:
        off = se2.between(T_i_j, motion.T_a_b)
        return bool(np.hypot(off[0], off[1]) <= self._config.borne_out_m and abs(off[2]) <= self._config.borne_out_rad)

    def _far_match(self, i: KeyscanId, place: Place, likeness: Likeness[KeyscanId]) -> PlaceMatch | None:
        """Verify the motions that the keypoints propose; the most convincing one, None if there is none."""
        stored = self._places[i]
        return self._best(stored, place, motions(stored, place, self._config.motions), likeness)

    def _best(
        self, stored: Place, place: Place, proposed: Sequence[Motion], likeness: Likeness[KeyscanId]
    ) -> PlaceMatch | None:
        if not proposed:
            return None
        checks = [self._verify(stored, place, motion) for motion in proposed]
        best = max(checks, key=lambda check: (check.strict, check.worse.explained - check.worse.violation))
        alike = likeness.of(stored.id, proposed[0].share)
        return PlaceMatch(stored.id, place.id, place.channel, alike, best, predicted=False)

    def _verify(self, stored: Place, place: Place, motion: Motion) -> Verification:
        a, b = self._submap_of(stored), self._submap_of(place)
        return verify(a, b, motion.T_a_b, self._config.verification, motion.information)
