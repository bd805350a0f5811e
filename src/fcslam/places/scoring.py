"""How alike a query and stored places are, without touching a place that has nothing in common with it; compiled."""

from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from fcslam.features.codes import CodeWords, popcount
from fcslam.places.kmeans_tree import Tree, near_leaves
from fcslam.places.postings import BLOCK, OLDER, ROWS, Entries, newest_block, prefetch_block
from fcslam.places.prefetch import prefetch
from fcslam.records import FloatArray

_CODES_AT_ONCE = 32
"""Codes of a query whose words are read together: so many that cache misses overlap, so few that all stays there."""
TINY = 1e-300
"""In the place of a sum that may be zero."""


class ScoreBuffers(NamedTuple):
    """What is known of every row while a query is answered.

    Zeros between queries: to clear what was touched costs less than as many zeros as there are places.
    """

    scores: FloatArray
    """Shape (R,)."""
    marks: NDArray[np.int32]
    """Shape (R,): of the word or code that is looked at."""
    touched: NDArray[np.int32]
    """Shape (R,): rows that have a score, in the order in which they were met."""
    here: NDArray[np.int32]
    """Shape (R,): rows that have a mark."""


def empty_buffers(rows: int) -> ScoreBuffers:
    """For so many rows."""
    return ScoreBuffers(np.zeros(rows), np.zeros(rows, np.int32), np.empty(rows, np.int32), np.empty(rows, np.int32))


@njit(cache=True)
def score_words(
    entries: Entries, buffers: ScoreBuffers, place_count: int, leaves: NDArray[np.int32], weights: FloatArray
) -> tuple[NDArray[np.int32], FloatArray]:
    """Sum of min(query, place) over the common words: rows that have one, and their scores.

    Args:
        entries: the stored places, with their norms.
        buffers: blank, for all rows; it is left so.
        place_count: N of the inverse document frequencies.
        leaves: shape (K,), the query's words, each once.
        weights: shape (K,), tf-idf of the query, L1 norm 1.
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


@njit(cache=True)
def score_matches(
    entries: Entries, tree: Tree, buffers: ScoreBuffers, place_count: int, codes: CodeWords, beam: int, near_bits: int
) -> tuple[NDArray[np.int32], FloatArray]:
    """Share of the query's descriptors that a place has, too, in [0, 1]; a place is wholly like itself.

    A descriptor of the query gives each place 1 - (d / (near_bits + 1))^2 for the nearest one of its own, d bits away:
    Epanechnikov's kernel. It counts ln((N + 1) / n), where n is the sum of what it gives to all places: what many
    places have tells little. A place of m times as many descriptors as the query has, m > 1, has more chances to be
    near and 1 / sqrt(m) of the share: the geometric mean of the shares of both.

    Args:
        entries: the stored places.
        tree: the words.
        buffers: blank, for all rows; it is left so.
        place_count: N, the places that are stored.
        codes: shape (K, 4), of the query.
        beam: words that are looked through for each code.
        near_bits: codes that differ in no more bits are of the same thing.
    """
    scores, closeness, touched, here = buffers  # closeness: bits that are missing to one more than near_bits
    gives = 1.0 - ((near_bits + 1.0 - np.arange(near_bits + 2)) / (near_bits + 1.0)) ** 2
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
                    close = near_bits + 1 - _distance(codes, k, entries.blocks, block, place)
                    if close > 0:
                        row = entries.numbers[block, ROWS + place]
                        if closeness[row] == 0:
                            here[found] = row
                            found += 1
                        closeness[row] = max(closeness[row], close)
                block, filled = entries.numbers[block, OLDER], BLOCK
        everywhere = 0.0
        for row in here[:found]:
            everywhere += gives[closeness[row]]
        weight = np.log((place_count + 1) / max(everywhere, 1.0))
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


@njit(cache=True)
def _taken(buffers: ScoreBuffers, total: int) -> tuple[NDArray[np.int32], FloatArray]:
    """The rows that were touched and their scores, which are cleared."""
    rows = buffers.touched[:total].copy()
    scores = buffers.scores[rows]
    buffers.scores[rows] = 0.0
    return rows, scores


@njit(cache=True)
def _distance(codes: CodeWords, k: int, blocks: NDArray[np.uint64], block: int, place: int) -> Any:
    """Bits between code k and the code of an entry."""
    bits = popcount(codes[k, 0] ^ blocks[block, 4 * place]) + popcount(codes[k, 1] ^ blocks[block, 4 * place + 1])
    bits += popcount(codes[k, 2] ^ blocks[block, 4 * place + 2]) + popcount(codes[k, 3] ^ blocks[block, 4 * place + 3])
    return np.int32(bits)


@njit(cache=True)
def _prefetch_leaves(entries: Entries, leaves: NDArray[np.int32]) -> None:
    """Announce the blocks of these leaves, -1 for none.

    A chain is read block after block, each a cache miss in a large index. Abreast, the misses of all chains overlap.
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
