"""How alike a query and stored places are, without touching a place that has nothing in common with it; compiled."""

from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from fcslam.features.codes import CodeWords, hamming
from fcslam.places.kmeans_tree import Tree, near_leaves
from fcslam.places.postings import BLOCK, Entries, block_size
from fcslam.records import FloatArray

_ABREAST = 32
"""Codes of a query whose words are read together: so many that cache misses overlap, so few that all stays there."""
TINY = 1e-300
"""In the place of a sum that may be zero."""


@njit(cache=True)
def score_words(
    entries: Entries, row_count: int, place_count: int, leaves: NDArray[np.int32], weights: FloatArray
) -> tuple[NDArray[np.int32], FloatArray]:
    """Sum of min(query, place) over the common words: rows that have one, and their scores.

    Args:
        entries: the stored places.
        row_count: rows in use, forgotten places included.
        place_count: N of the inverse document frequencies.
        leaves: shape (K,), the query's words, each once.
        weights: shape (K,), tf-idf of the query, L1 norm 1.
    """
    scores, counts = np.zeros(row_count), np.zeros(row_count, np.int32)
    touched, here = np.empty(row_count, np.int32), np.empty(row_count, np.int32)
    total = 0
    for k in range(leaves.shape[0]):
        leaf, found = leaves[k], 0
        if entries.documents[leaf] == 0:
            continue
        idf = np.log(place_count / entries.documents[leaf])
        block, filled = entries.newest[leaf], block_size(entries, leaf)
        while block >= 0:
            for row in entries.rows[block, :filled]:
                if counts[row] == 0:
                    here[found] = row
                    found += 1
                counts[row] += 1
            block, filled = entries.older[block], BLOCK
        for row in here[:found]:
            if scores[row] == 0.0:
                touched[total] = row
                total += 1
            norm = entries.counts[row] * np.log(place_count) - entries.log_documents[row]
            scores[row] += min(weights[k], counts[row] * idf / norm)
            counts[row] = 0
    return touched[:total], scores[touched[:total]]


@njit(cache=True)
def score_matches(
    entries: Entries, tree: Tree, row_count: int, place_count: int, codes: CodeWords, beam: int, near_bits: int
) -> tuple[NDArray[np.int32], FloatArray]:
    """Share of the query's descriptors that a place has, too, in [0, 1]; a place is wholly like itself.

    A descriptor of the query gives each place 1 - (d / (near_bits + 1))^2 for the nearest one of its own, d bits away:
    Epanechnikov's kernel. It counts ln((N + 1) / n), where n is the sum of what it gives to all places: what many
    places have tells little.

    Args:
        entries: the stored places.
        tree: the words.
        row_count: rows in use, forgotten places included.
        place_count: N, the places that are stored.
        codes: shape (K, 4), of the query.
        beam: words that are looked through for each code.
        near_bits: codes that differ in no more bits are of the same thing.
    """
    scores, nearest = np.zeros(row_count), np.full(row_count, near_bits + 1, np.int32)
    touched, here = np.empty(row_count, np.int32), np.empty(row_count, np.int32)
    total, whole = 0, 0.0
    leaves = near_leaves(tree, codes, beam)
    for k in range(codes.shape[0]):
        if k % _ABREAST == 0:
            _fetch(entries, leaves[k : k + _ABREAST].ravel())
        found = 0
        for leaf in leaves[k]:
            if leaf < 0:
                break
            block, filled = entries.newest[leaf], block_size(entries, leaf)
            while block >= 0:
                for place in range(filled):
                    distance = np.int32(hamming(codes[k], entries.codes[block, place]))
                    if distance <= near_bits:
                        row = entries.rows[block, place]
                        if nearest[row] > near_bits:
                            here[found] = row
                            found += 1
                        nearest[row] = min(nearest[row], distance)
                block, filled = entries.older[block], BLOCK
        everywhere = 0.0
        for row in here[:found]:
            everywhere += 1.0 - (nearest[row] / (near_bits + 1.0)) ** 2
        weight = np.log((place_count + 1) / max(everywhere, 1.0))
        whole += weight
        for row in here[:found]:
            if scores[row] == 0.0:
                touched[total] = row
                total += 1
            scores[row] += weight * (1.0 - (nearest[row] / (near_bits + 1.0)) ** 2)
            nearest[row] = near_bits + 1
    return touched[:total], scores[touched[:total]] / max(whole, TINY)


@njit(cache=True)
def _fetch(entries: Entries, leaves: NDArray[np.int32]) -> Any:
    """Bring the codes of these leaves (-1 for none) into the cache.

    A chain is read block after block, each a cache miss in a large index. Read abreast, the chains' misses overlap.
    """
    blocks = np.empty(leaves.shape[0], np.int32)
    count, read = 0, np.uint64(0)
    for leaf in leaves:
        if leaf >= 0 and entries.newest[leaf] >= 0:
            blocks[count] = entries.newest[leaf]
            count += 1
    while count:
        left = 0
        for block in blocks[:count]:
            read ^= entries.codes[block, 0, 0] ^ entries.codes[block, BLOCK // 4, 0]
            read ^= entries.codes[block, BLOCK // 2, 0] ^ entries.codes[block, 3 * BLOCK // 4, 0]
            if entries.older[block] >= 0:
                blocks[left] = entries.older[block]
                left += 1
        count = left
    return read  # what is computed is not left out by the compiler if it is returned
