"""What the order of places tells about matches: which places are too recent to be asked for, how alike neighbours are,
and whether neighbours match neighbours.

All of it is about streams, places 0, 1, 2 ... of one robot in the order of time, each asked before it is stored. Of
similarities (Q, G) the rows are queries, the columns stored places; a similarity of 0 retrieves nothing.
"""

import numpy as np
from numpy.typing import NDArray

from fcslam.records import FloatArray, Scalar

LEAST_TO_PREVIOUS = 0.005
"""A query less like the place before it, as after a quick turn or a covered lens, has nothing to be measured by."""


def excluding_recent(stamps: NDArray[np.int64] | FloatArray, gap: float) -> NDArray[np.bool_]:
    """Which places (columns) a query (row) may be answered by: those that came ``gap`` or more before it.

    Every place is like the ones just before it, and to find these again says nothing.

    Args:
        stamps: shape (N,), ascending; times, or numbers of places.
        gap: in the unit of the stamps.
    """
    return np.asarray((stamps[:, None] - stamps >= gap) & np.tri(len(stamps), k=-1, dtype=np.bool_))


def normalised_by_previous(
    similarity: FloatArray, to_previous: FloatArray, least: float = LEAST_TO_PREVIOUS
) -> FloatArray:
    """s(t, j) / s(t, t - 1), shape (Q, G): about 1 where a place is as like the query as the one just before it.

    How alike two views can be depends on how much there is to see and on how common it is, and the robot's own
    previous place tells (Galvez-Lopez and Tardos 2012, eq. 2). All answers to a query change by one factor: their
    order stays, and only a threshold over several queries is another one.

    Args:
        similarity: shape (Q, G), not negative.
        to_previous: shape (Q,), of each query with the place before it.
        least: a query that is less like it retrieves nothing.
    """
    known = to_previous >= max(least, float(np.finfo(np.float64).tiny))
    return np.divide(similarity, to_previous[:, None], out=np.zeros(similarity.shape), where=known[:, None])


def temporally_consistent(similarity: FloatArray, hits: int, reach: int) -> FloatArray:
    """The similarities of those pairs that end a run of ``hits`` queries whose matches lie side by side, else 0.

    Each query before the last one matches what is most similar to it, equals included; the next match of a run lies at
    most ``reach`` stored places away, in either direction: a robot may drive its way back.

    Args:
        similarity: shape (Q, G), queries and stored places in the order of the robot's way.
        hits: queries in a row; 1 keeps everything.
        reach: 0 for the same stored place.
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
    """Mean similarity of the last ``places`` queries with what lies side by side in the same order, or in the opposite.

    Where the query and a stored place are t and j, query t - k takes part with the most similar place at most
    ``reach`` away from j - k, or from j + k on the way back, whichever mean is higher (after SeqSLAM, Milford and Wyeth
    2012). What is not there counts 0, and what is not similar at all stays so.

    Args:
        similarity: shape (Q, G), queries and stored places in the order of the robot's way.
        places: 1 keeps everything as it is.
        reach: how unevenly places may lie on both ways; the last query itself is not shifted.
    """
    rows, columns = similarity.shape
    near = _most_nearby(np.pad(similarity, ((places, 0), (places, places))), reach)

    def mean(direction: int) -> FloatArray:
        corners = [(places - k, places - direction * k) for k in range(1, places)]
        earlier = [near[top : top + rows, left : left + columns] for top, left in corners]
        return np.asarray(sum(earlier, similarity) / places)

    return np.where(similarity > 0.0, np.maximum(mean(1), mean(-1)), 0.0)


def _most_nearby(values: NDArray[Scalar], reach: int) -> NDArray[Scalar]:
    """The largest within ``reach`` places along the last axis; nothing in ``values`` is negative."""
    width = values.shape[-1]
    padded = np.pad(values, [*[(0, 0)] * (values.ndim - 1), (reach, reach)])
    return np.asarray(np.max([padded[..., first : first + width] for first in range(2 * reach + 1)], axis=0))
