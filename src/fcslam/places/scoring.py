"""Similarity of a query to the stored places by the inverted index: places without a common word cost nothing.

Compiled.
"""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fcslam.compiled import njit
from fcslam.features.codes import CodeWords, popcount
from fcslam.places.kmeans_tree import Tree, near_leaves
from fcslam.places.postings import BLOCK, OLDER, ROWS, Entries, newest_block, prefetch_block
from fcslam.places.prefetch import prefetch
from fcslam.records import FloatArray

_CODES_AT_ONCE = 32
"""Codes of a query whose words are prefetched together: enough to overlap cache misses, few enough for the cache."""
NEAR_BITS = 56
"""Largest Hamming distance of matching descriptors, bits."""
TINY = 1e-300
"""Smallest divisor, in place of a sum that may be zero."""


class ScoreBuffers(NamedTuple):
    """Work buffers of a query, one entry for each row.

    They are zero between queries. A query clears only the entries that it used, which is cheaper than new arrays.
    """

    scores: FloatArray
    """Shape (R,)."""
    marks: NDArray[np.int32]
    """Shape (R,): counts or closeness for the present word or code of the query."""
    touched: NDArray[np.int32]
    """Shape (R,): rows with a score, in the order in which they were found."""
    here: NDArray[np.int32]
    """Shape (R,): rows with a mark."""


def empty_buffers(rows: int) -> ScoreBuffers:
    """Zeroed buffers for ``rows`` rows."""
    return ScoreBuffers(np.zeros(rows), np.zeros(rows, np.int32), np.empty(rows, np.int32), np.empty(rows, np.int32))


@njit
def score_words(
    entries: Entries, buffers: ScoreBuffers, place_count: int, leaves: NDArray[np.int32], weights: FloatArray
) -> tuple[NDArray[np.int32], FloatArray]:
    """Sum of min(query, place) over the common words, the L1 score of DBoW2: eq. (4) of FC-SLAM in [0, 1].

    Args:
        entries: the stored places, with their norms.
        buffers: zero for all rows; zero again at the end.
        place_count: N of the inverse document frequencies.
        leaves: shape (K,), the query's words, each once.
        weights: shape (K,), tf-idf of the query, L1 norm 1.

    Returns:
        Rows (M,) with a common word and their scores (M,), in [0, 1].
    """
    scores, counts, touched, here = buffers
    total = 0
    for k in range(leaves.shape[0]):
        leaf, found = leaves[k], 0
        if entries.documents[leaf] == 0:
            continue
        idf = np.log(place_count / entries.documents[leaf])
        block, filled = newest_block(entries, leaf)
        while block >= 0:
            for row in entries.numbers[block, ROWS : ROWS + filled]:
                if counts[row] == 0:
                    here[found] = row
                    found += 1
                counts[row] += 1
            block, filled = entries.numbers[block, OLDER], BLOCK
        for row in here[:found]:
            if scores[row] == 0.0:
                touched[total] = row
                total += 1
            norm = entries.counts[row] * np.log(place_count) - entries.log_documents[row]
            scores[row] += min(weights[k], counts[row] * idf / norm)
            counts[row] = 0
    taken: tuple[NDArray[np.int32], FloatArray] = _taken(buffers, total)
    return taken


@njit
def score_matches(
    entries: Entries, tree: Tree, buffers: ScoreBuffers, place_count: int, codes: CodeWords, beam: int
) -> tuple[NDArray[np.int32], FloatArray]:
    """Weighted share of the query's descriptors that match a descriptor of a place; 1 for the query itself.

    Each descriptor of the query votes for a place with the Epanechnikov kernel 1 - (d / (NEAR_BITS + 1))^2 of the
    distance d to its nearest descriptor there. Its weight is ln((N + 1) / n), where n is the sum of its votes: a
    descriptor that many places have says little (idf). A place with m > 1 times as many descriptors as the query has
    more chances to match. So its score is divided by sqrt(m), which gives the geometric mean of the shares of both.

    Args:
        entries: the stored places.
        tree: the vocabulary.
        buffers: zero for all rows; zero again at the end.
        place_count: N, number of stored places.
        codes: shape (K, 4), of the query.
        beam: words that are searched for each code.

    Returns:
        Rows (M,) with a match and their scores (M,), in [0, 1].
    """
    scores, closeness, touched, here = buffers  # closeness: NEAR_BITS + 1 - distance
    gives = 1.0 - ((NEAR_BITS + 1.0 - np.arange(NEAR_BITS + 2)) / (NEAR_BITS + 1.0)) ** 2
    total, whole = 0, 0.0
    leaves = near_leaves(tree, codes, beam)
    for k in range(codes.shape[0]):
        if k % _CODES_AT_ONCE == 0:
            _prefetch_leaves(entries, leaves[k : k + _CODES_AT_ONCE].ravel())
        found = 0
        for leaf in leaves[k]:
            if leaf < 0:
                break
            block, filled = newest_block(entries, leaf)
            while block >= 0:
                for place in range(filled):
                    close = NEAR_BITS + 1 - _distance(codes, k, entries.blocks, block, place)
                    if close > 0:
                        row = entries.numbers[block, ROWS + place]
                        if closeness[row] == 0:
                            here[found] = row
                            found += 1
                        closeness[row] = max(closeness[row], close)
                block, filled = entries.numbers[block, OLDER], BLOCK
        votes = 0  # whole numbers: the sum must not depend on the order of the entries in memory
        for row in here[:found]:
            votes += closeness[row] * (2 * NEAR_BITS + 2 - closeness[row])
        weight = np.log((place_count + 1) / max(votes / (NEAR_BITS + 1.0) ** 2, 1.0))
        whole += weight
        for row in here[:found]:
            if scores[row] == 0.0:
                touched[total] = row
                total += 1
            scores[row] += weight * gives[closeness[row]]
            closeness[row] = 0
    rows, shares = _taken(buffers, total)
    for position, row in enumerate(rows):
        shares[position] *= np.sqrt(min(1.0, codes.shape[0] / entries.counts[row])) / max(whole, TINY)
    return rows, shares


@njit
def _taken(buffers: ScoreBuffers, total: int) -> tuple[NDArray[np.int32], FloatArray]:
    """The touched rows (M,) and their scores (M,); clears the scores."""
    rows = buffers.touched[:total].copy()
    scores = buffers.scores[rows]
    buffers.scores[rows] = 0.0
    return rows, scores


@njit(allocates=False)
def _distance(codes: CodeWords, k: int, blocks: NDArray[np.uint64], block: int, place: int) -> Any:
    """Hamming distance of code k and the code of an entry."""
    bits = popcount(codes[k, 0] ^ blocks[block, 4 * place]) + popcount(codes[k, 1] ^ blocks[block, 4 * place + 1])
    bits += popcount(codes[k, 2] ^ blocks[block, 4 * place + 2]) + popcount(codes[k, 3] ^ blocks[block, 4 * place + 3])
    return np.int32(bits)


@njit
def _prefetch_leaves(entries: Entries, leaves: NDArray[np.int32]) -> None:
    """Prefetch the blocks of these leaves (-1: none).

    Reading a chain block by block costs one cache miss each in a large index. All chains together overlap them.
    """
    for leaf in leaves:
        if leaf >= 0:
            prefetch(entries.heads, leaf, 0)
    blocks, count = np.empty(leaves.shape[0], np.int32), 0
    for leaf in leaves:
        if leaf >= 0 and entries.heads[leaf, 0] >= 0:
            blocks[count] = entries.heads[leaf, 0]
            count += 1
    while count:
        for block in blocks[:count]:
            prefetch_block(entries, block)
        left = 0
        for block in blocks[:count]:
            older = entries.numbers[block, OLDER]
            if older >= 0:
                blocks[left] = older
                left += 1
        count = left
