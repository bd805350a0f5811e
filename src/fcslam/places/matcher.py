"""Place matching in the cloud: compares a new place with stored ones and returns M_ij (FC-SLAM, Algorithm 1).

Candidates are all places while the fleet is small, and those that the vocabulary retrieves once it is large. Between
robots in one map, candidates are the places that the map predicts to be near. Each candidate gives a rigid motion, and
the overlap of the two submaps under this motion decides. To the letter of the paper, the similarity alone decides.
"""

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from functools import lru_cache
from typing import Final, Self

import numpy as np
from pydantic import Field

from fcslam.config import Settings
from fcslam.geometry import se2
from fcslam.graph.evidence import DISTINCT_M, DISTINCT_RAD
from fcslam.lidar.pair_verification import Pair, VerifyPairs, verify_here
from fcslam.lidar.submap import Submap, agreement
from fcslam.lidar.verification import LOOSE, NO_PRIOR, Verification
from fcslam.places.index import PlaceIndex, QueryResult
from fcslam.places.motions import Motion, propose_motions
from fcslam.places.similarity import PAPER_SCALE
from fcslam.places.vocabulary import VocabularyConfig
from fcslam.records import Channel, ClosureStatus, FloatArray, KeyscanId, LoopClosure, Place, Reason, ReasonCode, frozen
from fcslam.storage.state_file import State

START_SHARE = 1.0 / 3.0
"""Share of the points of the loose gate that is enough where known starts predict a closure."""
NO_DESCRIPTORS = np.zeros((0, 32), np.uint8)
PLAUSIBLE_VIOLATION: Final = LOOSE.violation
"""Largest share of a new place's points in the free space of the stored one, at the motion that keypoints propose and
before any alignment. In simulations, 98 % of the true motions have less; a noisy real scanner has up to 0.14."""
MOST_DOUBTFUL: Final = 12
"""Motions with more that are verified for a new place: those with the least."""
WHOLE_PLACES: Final = 256
"""Places that are kept with their descriptors, 10 kB each: the index holds descriptors by word."""


class MatchDecision(StrEnum):
    """Rules that decide whether two places are the same."""

    GEOMETRY = "geometry"
    """The overlap of their submaps."""
    SIMILARITY = "similarity"
    """Their similarity alone: Algorithm 1, lines 14-17."""


ALIGNED_CANDIDATES = 2
"""Most similar places in the same map compared although it puts them elsewhere, for evidence against the join."""


class MatcherConfig(Settings):
    """Place matching."""

    decision: MatchDecision = Field(
        default=MatchDecision.GEOMETRY,
        description="what decides whether two places are the same. geometry: the overlap of their submaps; similarity: "
        "at least delta (Algorithm 1 of FC-SLAM), for a rigid fleet.fusion only",
    )
    delta: float = Field(
        default=0.85,
        ge=0.0,
        le=PAPER_SCALE,
        description="least similarity of the same place on the scale of eq. (4), where it is 4 for a place with "
        "itself, decision similarity (delta of Algorithm 1)",
    )
    small_fleet: int = Field(
        default=150,
        ge=0,
        description="up to this many places of unaligned robots are all compared; beyond, the vocabulary proposes some",
    )
    candidates: int = Field(
        default=20, gt=0, description="places of unaligned robots that the vocabulary proposes for a new place"
    )
    most_places: int = Field(
        default=100_000, gt=0, description="most places stored of one channel; beyond, the oldest are forgotten"
    )
    most_nearby: int = Field(
        default=12,
        gt=0,
        description="most places of one robot and channel in a square of nearby_m; beyond, the oldest is forgotten",
    )
    most_sessions_nearby: int = Field(
        default=2,
        gt=0,
        description="most sessions of one robot that keep places of one channel in a square of nearby_m; beyond, the "
        "oldest are forgotten",
    )
    nearby_m: float = Field(
        default=2.0, gt=0.0, description="side of the squares of the map in which the number of places is limited [m]"
    )
    vocabulary: VocabularyConfig = Field(default=VocabularyConfig(), description="dynamic vocabulary")


@dataclass(frozen=True, slots=True)
class PlaceMatch(LoopClosure):
    """The comparison of a stored place i with the new place j: verified if they match, else a candidate.

    Before the first vocabulary, ``similarity`` is the share of matching descriptors if it is known. ``information`` is
    that of ``Verification``, or zero if no geometry measured ``T_i_j``.
    """

    explained: float = 0.0
    """Share of the points in known area that lie on a surface, of the worse direction."""
    predicted: bool = False
    """Whether the robots were in one map already and it predicted this pair."""

    @property
    def M(self) -> bool:
        """The matching flag M_ij of FC-SLAM: whether both are the same place."""
        return self.status is ClosureStatus.VERIFIED

    @classmethod
    def verified(
        cls, i: KeyscanId, j: KeyscanId, channel: Channel, similarity: float, check: Verification, predicted: bool
    ) -> Self:
        """Decision of geometry; a predicted pair needs less."""
        return cls(
            i,
            j,
            channel,
            similarity,
            T_i_j=frozen(check.T_a_b),
            information=frozen(check.information),
            status=_status(check.loose if predicted else check.strict),
            reason=check.loose_reason if predicted else check.reason,
            informative=check.informative,
            explained=check.worse.explained,
            predicted=predicted,
        )

    @classmethod
    def similar(cls, i: KeyscanId, j: KeyscanId, channel: Channel, similarity: float, delta: float) -> Self:
        """Decision by words (Algorithm 1, lines 14-17). The paper takes both poses for one."""
        score = PAPER_SCALE * similarity
        return cls(
            i,
            j,
            channel,
            similarity,
            T_i_j=frozen(np.zeros(3)),
            information=frozen(np.zeros((3, 3))),
            status=_status(score >= delta),
            reason=Reason(ReasonCode.SIMILAR, score, delta, "delta"),
            informative=False,
        )


def _status(matches: bool) -> ClosureStatus:
    return ClosureStatus.VERIFIED if matches else ClosureStatus.CANDIDATE


_Comparison = tuple[KeyscanId, Sequence[Motion], bool]
"""Pairs of a stored place to be verified: the place i; possible T_i_j (none: no match); whether they are predicted."""


class PlaceMatcher:
    """The places of one channel and detector version, with their dynamic vocabulary."""

    def __init__(
        self,
        config: MatcherConfig,
        submap_of: Callable[[Place], Submap],
        rng: np.random.Generator,
        on_forget: Callable[[Place], None] = lambda _: None,
        noise_of: Callable[[Place], float] = lambda _: 0.0,
        verify_pairs: VerifyPairs = verify_here,
    ) -> None:
        """Start without places.

        Args:
            config: thresholds.
            submap_of: the submap that a place was described on.
            rng: seeds the vocabulary.
            on_forget: called with each place that is forgotten.
            noise_of: how much the submap of a place contradicts itself.
            verify_pairs: verifies pairs of submaps.
        """
        self._config = config
        self._submap_of = submap_of
        self._on_forget = on_forget
        self._noise_of = noise_of
        self._verify_pairs = verify_pairs
        self._places: dict[KeyscanId, Place] = {}
        """Without the descriptors that the index holds."""
        self._use(PlaceIndex(config.vocabulary, rng))
        self._backlog: list[Place] = []

    def __len__(self) -> int:
        return len(self._places)

    @property
    def word_count(self) -> int:
        """Words of the vocabulary; 0 before it is needed."""
        return self._index.word_count

    def __iter__(self) -> Iterator[KeyscanId]:
        """Identifiers of the stored places, the oldest first."""
        return iter(self._places)

    def match(
        self, place: Place, predicted: Mapping[KeyscanId, FloatArray], is_unaligned: Callable[[KeyscanId], bool]
    ) -> list[PlaceMatch]:
        """Compare a new place with the stored places that may be the same, then store it.

        ``predicted`` has T_i_j (3,) of the stored places i that the joint map predicts to be near; forgotten places are
        ignored. ``is_unaligned`` says whether a stored place belongs to a robot in another map, whose relative pose is
        unknown.
        """
        comparable = bool(predicted) or any(is_unaligned(i) for i in self._places)
        result = self._query(place) if comparable else QueryResult[KeyscanId]()  # Algorithm 1, lines 11-13
        if self._config.decision is MatchDecision.SIMILARITY:
            matches = self._similar(place, result, is_unaligned)
        else:
            matches = self._verified(self._comparisons(place, result, predicted, is_unaligned), place, result)
        self._places[place.id] = place
        self._backlog.append(place)
        while len(self._places) > self._config.most_places:  # bounds the memory of long missions
            self.forget(next(iter(self._places)))
        return matches

    def match_at(self, place: Place, expected: Mapping[KeyscanId, FloatArray]) -> list[PlaceMatch]:
        """The stored places that a new place overlaps about where known starts of their robots put it.

        ``place`` is j, not stored here; ``expected`` has T_i_j (3,) of the stored places i; forgotten ones are ignored.
        """
        kept = [(i, T_i_j) for i, T_i_j in expected.items() if i in self._places]
        pairs = [self._pair(i, place, Motion(T_i_j, NO_PRIOR, 0.0), predicted=True) for i, T_i_j in kept]
        fewer = replace(LOOSE, count=round(START_SHARE * LOOSE.count))
        checks = self._verify_pairs([pair._replace(loose=fewer) for pair in pairs])
        matches = [
            PlaceMatch.verified(i, place.id, place.channel, 0.0, check, predicted=True)
            for (i, _), check in zip(kept, checks, strict=True)
        ]
        return [replace(match, predicted=False) for match in matches if match.M]

    def match_again(self, place: KeyscanId, others: Collection[KeyscanId]) -> list[PlaceMatch]:
        """Compare a stored place with other stored places, without a prediction; forgotten ones are ignored."""
        if place not in self._places or self._config.decision is MatchDecision.SIMILARITY:
            return []
        stored, kept = self._stored(place), [i for i in others if i in self._places]
        result = self._query(stored)
        chosen = self._candidates(result, frozenset(kept).__contains__)
        return self._verified([self._far(i, stored) for i in chosen], stored, result)

    def _similar(
        self, place: Place, result: QueryResult[KeyscanId], is_unaligned: Callable[[KeyscanId], bool]
    ) -> list[PlaceMatch]:
        """The places with M_ij = 1, the most similar first."""
        found = result.best(len(self._places), is_unaligned)
        matches = [
            PlaceMatch.similar(stored, place.id, place.channel, similarity, self._config.delta)
            for stored, similarity in found
        ]
        return [match for match in matches if match.M]

    def _comparisons(
        self,
        place: Place,
        result: QueryResult[KeyscanId],
        predicted: Mapping[KeyscanId, FloatArray],
        is_unaligned: Callable[[KeyscanId], bool],
    ) -> list[_Comparison]:
        """The pairs that geometry is to verify."""
        kept = {i: T_i_j for i, T_i_j in predicted.items() if i in self._places}
        near = [self._near(i, place, T_i_j) for i, T_i_j in kept.items()]
        lookalikes = self._lookalikes(place.id.robot, result, predicted, is_unaligned)
        others = (*self._candidates(result, is_unaligned), *lookalikes)
        return [*near, *(self._far(i, place) for i in others)]

    def state(self) -> State:
        """The state that ``restore`` needs."""
        places = list(self._places.values())
        return {
            "ids": [place.id for place in places],
            "spans": np.array([(place.first, place.last) for place in places], np.int64).reshape(-1, 2),
            "counts": np.array([len(place.keypoints) for place in places], np.int64),
            "keypoints": np.concatenate([place.keypoints for place in places]) if places else np.zeros((0, 2)),
            "descriptors": np.concatenate(
                [self._index.all_descriptors(), *(place.descriptors for place in self._backlog)]
            ),
            "index": self._index.state(),
        }

    def restore(self, state: State, channel: Channel, detector_version: str) -> None:
        """Take over a ``state`` of places of this channel and detector version."""
        ids = [KeyscanId(*identifier) for identifier in state["ids"]]
        ends = np.cumsum(state["counts"])[:-1]
        keypoints = np.split(frozen(state["keypoints"], np.float32), ends)
        descriptors = np.split(frozen(state["descriptors"], np.uint8), ends)
        indexed = state["index"]["size"]  # the oldest ones
        kept = [*([NO_DESCRIPTORS] * indexed), *(codes.copy() for codes in descriptors[indexed:])]
        for row in zip(ids, state["spans"].tolist(), keypoints, kept, strict=True):
            identifier, (first, last), points, codes = row
            self._places[identifier] = Place(
                identifier, channel, detector_version, first, last, points, frozen(codes, np.uint8)
            )
        self._use(PlaceIndex.restored(self._config.vocabulary, state["index"], ids[:indexed], descriptors[:indexed]))
        self._backlog = list(self._places.values())[indexed:]

    def _use(self, index: PlaceIndex[KeyscanId]) -> None:
        self._index = index

        @lru_cache(WHOLE_PLACES)
        def indexed(i: KeyscanId) -> Place:
            return replace(self._places[i], descriptors=index.descriptors(i))

        self._indexed = indexed

    def _query(self, place: Place) -> QueryResult[KeyscanId]:
        for stored in self._backlog:  # a single robot never needs the vocabulary
            self._index.add(stored.id, stored.descriptors)
            self._places[stored.id] = replace(stored, descriptors=NO_DESCRIPTORS)
        self._backlog.clear()
        return self._index.compare(place.descriptors)

    def _stored(self, i: KeyscanId) -> Place:
        """A stored place with its descriptors."""
        return self._indexed(i) if i in self._index else self._places[i]

    def forget(self, place: KeyscanId) -> None:
        """Remove a place."""
        gone = self._places.pop(place)
        if place in self._index:
            self._index.forget(place)
        else:
            self._backlog = [stored for stored in self._backlog if stored.id != place]
        self._on_forget(gone)

    def _candidates(self, result: QueryResult[KeyscanId], is_unaligned: Callable[[KeyscanId], bool]) -> list[KeyscanId]:
        """All places of unaligned robots while they are few, else the most similar ones."""
        eligible = [i for i in self._places if is_unaligned(i)]
        if len(eligible) <= self._config.small_fleet or self._index.trained_on is None:
            return eligible
        return [stored for stored, _ in result.best(self._config.candidates, is_unaligned)]

    def _lookalikes(
        self,
        robot: str,
        result: QueryResult[KeyscanId],
        predicted: Mapping[KeyscanId, FloatArray],
        is_unaligned: Callable[[KeyscanId], bool],
    ) -> list[KeyscanId]:
        """Most similar places of other robots in the same map that are not predicted: the join may be false."""

        def is_known(i: KeyscanId) -> bool:
            return i.robot != robot and i not in predicted and not is_unaligned(i)

        return [stored for stored, _ in result.best(ALIGNED_CANDIDATES, is_known)]

    def _near(self, i: KeyscanId, place: Place, T_i_j: FloatArray) -> _Comparison:
        """The comparison of a predicted pair.

        Submaps at nearby poses overlap, so LiDAR places need no further evidence. Images at nearby poses may show
        different things, so one of their motions must confirm the prediction. If none does, the pair is compared
        without the prediction, because the map may be wrong.
        """
        if place.channel is Channel.LIDAR:
            return i, [Motion(T_i_j, NO_PRIOR, 0.0)], True
        far = _, guesses, _ = self._far(i, place)
        confirmed = [motion for motion in guesses if self._confirms(motion, T_i_j)]
        return (i, confirmed[:1], True) if confirmed else far

    def _far(self, i: KeyscanId, place: Place) -> _Comparison:
        """The comparison of a pair that is not predicted, by its motions from keypoints."""
        return i, propose_motions(self._stored(i), place), False

    def _confirms(self, motion: Motion, T_i_j: FloatArray) -> bool:
        off = se2.between(T_i_j, motion.T_a_b)
        return bool(np.hypot(off[0], off[1]) <= DISTINCT_M and abs(off[2]) <= DISTINCT_RAD)

    def _verified(
        self, comparisons: Sequence[_Comparison], place: Place, result: QueryResult[KeyscanId]
    ) -> list[PlaceMatch]:
        """Verify the guesses of the comparisons; the best one of each counts."""
        comparisons = self._plausible(comparisons, place)
        pairs = [self._pair(i, place, guess, predicted) for i, guesses, predicted in comparisons for guess in guesses]
        checks = iter(self._verify_pairs(pairs))
        matches: list[PlaceMatch] = []
        for i, guesses, predicted in comparisons:
            found = [next(checks) for _ in guesses]
            if found:
                best = max(found, key=lambda check: (check.strict, check.worse.explained - check.worse.violation))
                similarity = result.similarity_of(i, guesses[0].share)
                matches.append(PlaceMatch.verified(i, place.id, place.channel, similarity, best, predicted))
        return matches

    def _plausible(self, comparisons: Sequence[_Comparison], place: Place) -> list[_Comparison]:
        """The comparisons without the proposed motions that contradict the free space most.

        Where many robots meet, most are false. To count points in free space takes a twentieth of an alignment's time.
        """
        doubted = [(n, guesses) for n, (_, guesses, predicted) in enumerate(comparisons) if not predicted]
        proposed = [(n, guess) for n, guesses in doubted for guess in guesses]
        if len(proposed) <= MOST_DOUBTFUL:
            return list(comparisons)
        violation = [self._violation(comparisons[n][0], place, guess.T_a_b) for n, guess in proposed]
        doubtful = [k for k in np.argsort(violation, kind="stable") if violation[k] > PLAUSIBLE_VIOLATION]
        left_out = set(doubtful[MOST_DOUBTFUL:])
        kept: dict[int, list[Motion]] = {n: [] for n, _ in proposed}
        for k, (n, guess) in enumerate(proposed):
            if k not in left_out:
                kept[n].append(guess)
        return [(i, kept.get(n, guesses), predicted) for n, (i, guesses, predicted) in enumerate(comparisons)]

    def _violation(self, i: KeyscanId, place: Place, T_i_j: FloatArray) -> float:
        """Share of the new place's points that lie in free space of a stored one."""
        return agreement(self._submap_of(place), self._submap_of(self._places[i]), T_i_j).violation

    def _pair(self, i: KeyscanId, place: Place, guess: Motion, predicted: bool) -> Pair:
        stored = self._places[i]
        a, b = self._submap_of(stored), self._submap_of(place)

        def noise() -> float:
            return self._noise_of(stored) + self._noise_of(place)

        return Pair(a, b, guess.T_a_b, guess.information, noise, predicted)
