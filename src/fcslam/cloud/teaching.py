"""Codes as teachers: what other robots' codes say about the points of one robot's camera place.

The cloud holds the codes and the positions of all places, and accepted closures say how they lie to one another. So a
robot can learn how others, in other light, describe the points that it sees, and no image leaves a robot. A point is
taught only where several places of others agree on its code.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from fcslam.features.codes import hamming_matrix
from fcslam.records import CODE_BYTES, Codes, FloatArray

SEARCH_M: Final = 0.15
"""Keypoints with like codes this close to each other tell how far the positions of two places are off."""
ALIKE_BITS: Final = 60
FEWEST_ALIKE: Final = 5
"""Fewest such keypoints; a place with fewer teaches nothing."""
SAME_POINT_M: Final = 0.06
"""Largest distance of two keypoints that are the same point, after the correction."""
AGREEING_BITS: Final = 64
"""A code farther than this from the majority of the bits does not count."""
FEWEST_PLACES: Final = 2
FARTHEST_BITS: Final = 100
"""Taught codes are at most this far from the robot's own code; two codes at random differ in 128 bits."""
RECORD_BYTES: Final = 2 + CODE_BYTES
"""Size of a taught point: its number in the place, and the code."""
HEAD_BYTES: Final = 6
"""Size of the head of a taught place: the number of the keyscan, and the number of points."""


class PlacePoints(NamedTuple):
    """The keypoints of a camera place in space."""

    positions: FloatArray
    """Shape (N, 3), metres."""
    codes: Codes
    """Shape (N, 32)."""


@dataclass(frozen=True, slots=True, eq=False)
class TaughtCodes:
    """The codes that others gave to some keypoints of a place."""

    rows: NDArray[np.int64]
    """Numbers of the keypoints in the place, shape (M,)."""
    codes: Codes
    """Shape (M, 32)."""
    places: NDArray[np.int64]
    """Places of others that agree on each code, shape (M,)."""

    @property
    def size_bytes(self) -> int:
        """Size of what the robot receives; nothing if there is nothing to teach."""
        return HEAD_BYTES + RECORD_BYTES * len(self.rows) if len(self.rows) else 0


def teach(place: PlacePoints, others: Sequence[PlacePoints]) -> TaughtCodes:
    """The codes of a place's keypoints on which places of other robots agree.

    Args:
        place: of the robot that learns.
        others: places of other robots that accepted closures connect to it, with positions in the base of the place.
    """
    given: list[list[Codes]] = [[] for _ in place.codes]
    for other in others:
        for row, code in zip(*_same_points(place, other), strict=True):
            given[row].append(code)
    rows, codes, counts = [], [], []
    for row, seen in enumerate(given):
        if len(seen) < FEWEST_PLACES:
            continue
        bits = np.unpackbits(np.array(seen), axis=1)
        agreeing = bits[np.sum(bits != _majority(bits, place.codes[row]), axis=1) <= AGREEING_BITS]
        # Most of all places must remain: two groups, one of them wrong, teach nothing.
        if len(agreeing) < FEWEST_PLACES or 2 * len(agreeing) <= len(seen):
            continue
        taught = _majority(agreeing, place.codes[row])
        if np.sum(taught != np.unpackbits(place.codes[row])) <= FARTHEST_BITS:
            rows.append(row)
            codes.append(np.packbits(taught))
            counts.append(len(agreeing))
    return TaughtCodes(
        np.array(rows, np.int64), np.array(codes, np.uint8).reshape(-1, CODE_BYTES), np.array(counts, np.int64)
    )


def _same_points(place: PlacePoints, other: PlacePoints) -> tuple[NDArray[np.int64], Codes]:
    """The place's keypoints that the other place has too, numbers (M,), and the other's codes of them (M, 32)."""
    none = np.empty(0, np.int64), np.empty((0, CODE_BYTES), np.uint8)
    if not len(place.codes) or not len(other.codes):
        return none
    gaps = other.positions[None, :] - place.positions[:, None]
    alike: NDArray[np.int64] = hamming_matrix(place.codes, other.codes).astype(np.int64)
    alike[np.linalg.norm(gaps, axis=2) > SEARCH_M] = ALIKE_BITS + 1
    best, back = np.argmin(alike, axis=1), np.argmin(alike, axis=0)
    rows = np.arange(len(place.codes))
    rows = rows[(alike[rows, best] <= ALIKE_BITS) & (back[best] == rows)]
    if len(rows) < FEWEST_ALIKE:
        return none
    moved = other.positions - np.median(gaps[rows, best[rows]], axis=0)
    distances, nearest = map(np.asarray, cKDTree(moved).query(place.positions, distance_upper_bound=SAME_POINT_M))
    nearest_back = np.asarray(cKDTree(place.positions).query(moved)[1])
    found = np.flatnonzero(np.isfinite(distances))
    found = found[nearest_back[nearest[found]] == found]
    return found, other.codes[nearest[found]]


def _majority(bits: NDArray[np.uint8], own: Codes) -> NDArray[np.uint8]:
    """The bits (256,) that most rows of (N, 256) have; of a tie, that of the robot's own code (32,)."""
    votes = bits.mean(axis=0)
    return np.where(votes == 0.5, np.unpackbits(own), votes > 0.5).astype(np.uint8)
