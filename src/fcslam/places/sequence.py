"""Temporal information for place recognition: excludes recent places, normalises scores, checks sequences.

The functions work on the stream of one robot: places 0, 1, 2 ... in the order of time, each queried before it is
stored. In similarities (Q, G), rows are queries and columns are stored places; a similarity of 0 retrieves nothing.
"""

import numpy as np
from numpy.typing import NDArray

from fcslam.records import FloatArray, Scalar

LEAST_TO_PREVIOUS = 0.005
"""Smallest similarity to the previous place that can normalise a query. It is smaller after a quick turn or with a
covered lens."""


def excluding_recent(stamps: NDArray[np.int64] | FloatArray, gap: float) -> NDArray[np.bool_]:
    """Mask of the places (columns) that a query (row) may retrieve: those at least ``gap`` before it, shape (N, N).

    A place is always similar to those just before it, so retrieving them is not a loop.

    Args:
        stamps: shape (N,), ascending; times, or numbers of places.
        gap: in the unit of the stamps.
    """
    return np.asarray((stamps[:, None] - stamps >= gap) & np.tri(len(stamps), k=-1, dtype=np.bool_))


def normalised_by_previous(
    similarity: FloatArray, to_previous: FloatArray, least: float = LEAST_TO_PREVIOUS
) -> FloatArray:
    """Normalised similarity score s(t, j) / s(t, t - 1), shape (Q, G) (Galvez-Lopez and Tardos 2012, eq. 2).

    The score that a true match can reach depends on the scene; the robot's previous place measures it. The order of
    the places of one query does not change. Only thresholds over several queries do.

    Args:
        similarity: shape (Q, G), not negative.
        to_previous: shape (Q,), similarity of each query to the place before it.
        least: a query with a smaller ``to_previous`` retrieves nothing.
    """
    known = to_previous >= max(least, float(np.finfo(np.float64).tiny))
    return np.divide(similarity, to_previous[:, None], out=np.zeros(similarity.shape), where=known[:, None])


def temporally_consistent(similarity: FloatArray, hits: int, reach: int) -> FloatArray:
    """Keep the similarities of pairs that end ``hits`` consecutive queries with neighbouring matches; others are 0.

    This is the temporal consistency check of DLoopDetector. Each earlier query of the run matches its most similar
    place, ties included. The next match lies at most ``reach`` stored places away, in either direction, because a
    robot may drive a route backwards.

    Args:
        similarity: shape (Q, G), queries and stored places in the order in which the robot passed them.
        hits: length of the run; 1 keeps everything.
        reach: largest step between successive matches, in stored places; 0 for the same place.

    Returns:
        Shape (Q, G).
    """
    most = similarity.max(axis=1, initial=0.0)
    matches = (similarity == most[:, None]) & (similarity > 0.0)
    lengths = np.zeros(similarity.shape, np.int64)
    before = np.zeros(similarity.shape[1], np.int64)
    for query in range(len(similarity)):
        lengths[query] = 1 + _most_nearby(before, reach)
        before = np.where(matches[query], lengths[query], 0)
    return np.where(lengths >= hits, similarity, 0.0)


def sequence_similarity(similarity: FloatArray, places: int, reach: int) -> FloatArray:
    """Mean similarity of the last ``places`` queries to a sequence of stored places, forwards or backwards.

    For query t and stored place j, query t - k contributes its most similar place within ``reach`` of j - k (same
    direction) or of j + k (opposite direction). The higher mean counts (after SeqSLAM, Milford and Wyeth 2012). Missing
    places count 0, and a similarity of 0 stays 0.

    Args:
        similarity: shape (Q, G), queries and stored places in the order in which the robot passed them.
        places: length of the sequence; 1 changes nothing.
        reach: largest offset of a place in the sequence, in stored places; the last query is not shifted.

    Returns:
        Shape (Q, G).
    """
    rows, columns = similarity.shape
    near = _most_nearby(np.pad(similarity, ((places, 0), (places, places))), reach)

    def mean(direction: int) -> FloatArray:
        corners = [(places - k, places - direction * k) for k in range(1, places)]
        earlier = [near[top : top + rows, left : left + columns] for top, left in corners]
        return np.asarray(sum(earlier, similarity) / places)

    return np.where(similarity > 0.0, np.maximum(mean(1), mean(-1)), 0.0)


def _most_nearby(values: NDArray[Scalar], reach: int) -> NDArray[Scalar]:
    """Sliding maximum over ``reach`` places on both sides along the last axis; ``values`` must not be negative."""
    width = values.shape[-1]
    padded = np.pad(values, [*[(0, 0)] * (values.ndim - 1), (reach, reach)])
    return np.asarray(np.max([padded[..., first : first + width] for first in range(2 * reach + 1)], axis=0))
