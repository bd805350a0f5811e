"""Variants of similarities that use the order of a stream."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Final

import numpy as np

from fcslam.lab.evaluation.places.scoring import DescribedSet, Scorer
from fcslam.places.sequence import normalised_by_previous, sequence_similarity, temporally_consistent
from fcslam.records import FloatArray

PLACES: Final = 3
"""Consecutive places that must agree, as in DLoopDetector."""
REACH: Final = 1
"""Largest offset between the steps of the query and of the stored sequence, in places."""


def plain(described: DescribedSet, scorer: Scorer) -> Mapping[str, FloatArray]:
    """The similarities (Q, G) unchanged, under an empty name."""
    return {"": scorer(described)}


def in_sequence(described: DescribedSet, scorer: Scorer) -> Mapping[str, FloatArray]:
    """The similarities (Q, G) unchanged, and for a stream also their sequence variants, by name."""
    place_set = described.place_set
    if not place_set.is_online:
        return plain(described, scorer)
    previous = np.eye(len(place_set.queries), k=-1, dtype=np.bool_)
    asked = scorer(replace(described, place_set=replace(place_set, admitted=place_set.admitted | previous)))
    similarity = np.where(place_set.admitted, asked, 0.0)
    shares = normalised_by_previous(similarity, asked.sum(axis=1, where=previous))
    return {
        "": similarity,
        "NSS": shares,
        f"{PLACES} in a row": temporally_consistent(similarity, PLACES, REACH),
        f"along {PLACES}": sequence_similarity(similarity, PLACES, REACH),
        f"NSS along {PLACES}": sequence_similarity(shares, PLACES, REACH),
    }
