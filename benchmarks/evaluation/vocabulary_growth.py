"""Figure 4 of FC-SLAM: how well words distinguish places while the vocabulary grows.

Places arrive in batches of 40. As in the paper, a probe group is a target, another view of the same place, and wrong
places. Here there are many groups, and no target is among the places that arrive. After each batch, every member is
described in the present vocabulary, and eq. (4), scaled to [0, 1], compares the target with the others.
"""

import copy
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np

from fcslam.metrics.bootstrap import Interval, mean_interval
from fcslam.places.index import PlaceIndex
from fcslam.places.similarity import similarity
from fcslam.places.vocabulary import Strategy, VocabularyConfig
from fcslam.records import Codes, FloatArray

from .place_features import BRUTE_FORCE, DescribedSet, matching_descriptors

BATCH: Final = 40
"""Places of a batch."""
DISTRACTORS: Final = 8
"""Wrong places of a probe group."""
MEASURES: Final = (
    "significance",
    "relative significance",
    "mismatch rate",
    "wrong places, mean",
    "wrong places, variance",
)


class ProbeGroup(NamedTuple):
    """A target, then another view of it, then wrong places; descriptors (N, 32) of each."""

    target: Codes
    others: tuple[Codes, ...]
    names: tuple[str, ...]
    """Names of the others, as in ``Arrival``."""


class Arrival(NamedTuple):
    """A place of the stream."""

    name: str
    descriptors: Codes


@dataclass(frozen=True, slots=True)
class Growth:
    """Results of one strategy while places arrive; U batches, G groups, W wrong places in each."""

    places: FloatArray
    """Number of places so far, shape (U,)."""
    similarities: FloatArray
    """Similarities to the target, shape (U, G, 1 + W), the true match first."""
    words: FloatArray
    """Number of words, shape (U,); NaN without a vocabulary."""
    seconds: FloatArray
    """CPU time to add the batch, shape (U,), seconds; NaN without an index."""

    def measures(self, update: int) -> dict[str, FloatArray]:
        """``MEASURES`` of every group after a batch, each of shape (G,)."""
        return group_measures(self.similarities[update])

    def intervals(self, update: int, seed: int) -> dict[str, Interval]:
        """Means over the groups with their bootstrap intervals."""
        rng = np.random.default_rng(seed)
        return {name: mean_interval(values, rng) for name, values in self.measures(update).items()}


def group_measures(similarities: FloatArray) -> dict[str, FloatArray]:
    """``MEASURES`` from similarities (G, 1 + W) whose first column is the true match, each of shape (G,).

    Relative significance is at least -1, and -1 where the true match has no similarity.
    """
    true, wrong = similarities[:, 0], similarities[:, 1:]
    ahead = true - wrong.max(axis=1)
    relative = np.divide(ahead, true, out=np.full_like(ahead, -1.0), where=true > 0.0)
    mismatch = (ahead <= 0.0).astype(np.float64)
    values = (ahead, np.maximum(relative, -1.0), mismatch, wrong.mean(axis=1), wrong.var(axis=1))
    return dict(zip(MEASURES, values, strict=True))


def draw_groups(
    sets: Sequence[DescribedSet], count: int, rng: np.random.Generator
) -> tuple[list[ProbeGroup], list[Arrival]]:
    """Draw probe groups from the first question of each set in turn, and list all other places in order.

    A target needs a match and 8 different places, so there may be fewer than ``count`` groups.
    """
    candidates = []
    for each in sets:
        truth = next(iter(each.place_set.questions.values()))
        usable = np.flatnonzero(truth.answerable & (truth.different.sum(axis=1) >= DISTRACTORS))
        candidates.append(list(rng.permutation(usable)))
    groups: list[ProbeGroup] = []
    targets: set[str] = set()
    while len(groups) < count and any(candidates):
        for each, waiting in zip(sets, candidates, strict=True):
            if waiting and len(groups) < count:
                query = int(waiting.pop())
                groups.append(_group(each, query, rng))
                targets.add(str(each.place_set.queries[query]))
    arrivals = [
        Arrival(str(path), place.descriptors)
        for each in sets
        for path, place in zip(each.place_set.gallery, each.gallery, strict=True)
        if str(path) not in targets
    ]
    return groups, arrivals


def _group(described: DescribedSet, query: int, rng: np.random.Generator) -> ProbeGroup:
    truth = next(iter(described.place_set.questions.values()))
    match = rng.choice(np.flatnonzero(truth.matches[query]))
    wrong = rng.choice(np.flatnonzero(truth.different[query]), DISTRACTORS, replace=False)
    chosen = [int(match), *map(int, wrong)]
    return ProbeGroup(
        described.queries[query].descriptors,
        tuple(described.gallery[g].descriptors for g in chosen),
        tuple(str(described.place_set.gallery[g]) for g in chosen),
    )


def grow_vocabulary(
    strategy: Strategy,
    arrivals: Sequence[Arrival],
    groups: Sequence[ProbeGroup],
    config: VocabularyConfig,
    seed: int,
) -> Growth:
    """Add the places in whole batches and measure after each."""
    # Places count from 0: with this L, the first training happens at the last place of the first batch.
    timing = {"strategy": strategy, "train_batch": BATCH - 2}
    index: PlaceIndex[str] = PlaceIndex(config.model_copy(update=timing), np.random.default_rng(seed))
    updates = len(arrivals) // BATCH
    _compile(index, arrivals[0].descriptors)
    words, seconds = np.zeros(updates), np.zeros(updates)
    similarities = np.zeros((updates, len(groups), 1 + DISTRACTORS))
    for update in range(updates):
        seconds[update] = sum(_timed_add(index, place) for place in arrivals[update * BATCH : (update + 1) * BATCH])
        words[update] = index.word_count
        for g, group in enumerate(groups):
            target = index.bag(group.target)
            similarities[update, g] = [similarity(target, index.bag(other)) for other in group.others]
    return Growth(_counts(updates), similarities, words, seconds)


def last_seconds(config: VocabularyConfig, arrivals: Sequence[Arrival], seed: int) -> float:
    """CPU time in which an index takes in the last ``BATCH`` places."""
    index: PlaceIndex[str] = PlaceIndex(config, np.random.default_rng(seed))
    _compile(index, arrivals[0].descriptors)
    for place in arrivals[:-BATCH]:
        index.add(place.name, place.descriptors)
    return sum(_timed_add(index, place) for place in arrivals[-BATCH:])


def _compile(like: PlaceIndex[str], descriptors: Codes) -> None:
    """Compile all code before the measurement."""
    warm = copy.deepcopy(like)
    warm.train([descriptors])
    warm.add("", descriptors)


def _timed_add(index: PlaceIndex[str], place: Arrival) -> float:
    began = time.thread_time()
    index.add(place.name, place.descriptors)
    return time.thread_time() - began


def fixed_growths(arrivals: Sequence[Arrival], groups: Sequence[ProbeGroup]) -> dict[str, Growth]:
    """Results of brute force, which does not change."""
    brute = [[matching_descriptors(g.target, other) / max(1, len(g.target)) for other in g.others] for g in groups]
    return {BRUTE_FORCE: _fixed(np.array(brute), len(arrivals) // BATCH, np.nan)}


def _fixed(similarities: FloatArray, updates: int, words: float) -> Growth:
    repeated = np.repeat(similarities[None], updates, axis=0)
    return Growth(_counts(updates), repeated, np.full(updates, words), np.full(updates, np.nan))


def _counts(updates: int) -> FloatArray:
    return BATCH * np.arange(1.0, updates + 1.0)


def ahead_of(first: Growth, other: Growth, measure: str, seed: int) -> Interval:
    """Mean difference of a measure, ``first`` minus ``other``, after the last batch, paired by group."""
    values = first.measures(-1)[measure] - other.measures(-1)[measure]
    return mean_interval(values, np.random.default_rng(seed))
