"""A k-means tree over binary codes, as in DBoW2: how to grow it and how to find the leaves near a code. All compiled.

The centres are binary: each bit is the majority of its cluster.
"""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fcslam.compiled import assign, njit
from fcslam.features.codes import CODE_BITS, CODE_WORDS, CodeWords, popcount
from fcslam.places.prefetch import prefetch

_MOST_PLANES = 32
"""Bits of a counter: no cluster has 2 ** 32 codes."""


class TreeShape(NamedTuple):
    """Limits of a tree's growth."""

    branching: int
    depth: int
    smallest_split: int
    """A cluster of fewer codes is a leaf."""
    iterations: int


class Tree(NamedTuple):
    """V vertices: 0 is the root, the children of a vertex are consecutive."""

    centres: CodeWords
    """Shape (V, 4)."""
    families: NDArray[np.int32]
    """Shape (V, 2): first child, number of children; side by side in memory because they are always read together."""

    @property
    def first_child(self) -> NDArray[np.int32]:
        """Shape (V,)."""
        return self.families[:, 0]

    @property
    def child_count(self) -> NDArray[np.int32]:
        """Shape (V,): 0 for a leaf."""
        return self.families[:, 1]


def bare_root() -> Tree:
    """A tree of one leaf."""
    return Tree(np.zeros((1, CODE_WORDS), np.uint64), np.zeros((1, 2), np.int32))


@njit
def find_leaves(tree: Tree, codes: CodeWords) -> NDArray[np.int32]:
    """Find the leaf of every code (N, 4), shape (N,); of equally near children the first is taken."""
    reached = np.zeros(codes.shape[0], np.int32)
    while _prefetch_children(tree, reached):
        for k in range(codes.shape[0]):
            first, children = tree.families[reached[k], 0], tree.families[reached[k], 1]
            if children:
                reached[k] = _nearest(codes, k, tree.centres, first, first + children)
    return reached


@njit
def near_leaves(tree: Tree, codes: CodeWords, beam: int) -> NDArray[np.int32]:
    """At most ``beam`` leaves near each code (K, 4), shape (K, beam), -1 after the last; first that of ``find_leaves``.

    Each level keeps the ``beam`` nearest vertices, and always the one on the path of ``find_leaves``. All codes descend
    together, one level at a time, so that their cache misses overlap.
    """
    kept, distances = np.full((codes.shape[0], beam), -1, np.int32), np.zeros((codes.shape[0], beam), np.int32)
    above, reached = np.empty(beam, np.int32), np.empty(beam, np.int32)
    kept[:, 0] = 0
    while _prefetch_children(tree, kept.reshape(-1)):
        for k in range(codes.shape[0]):
            for position in range(beam):
                above[position], reached[position] = kept[k, position], distances[k, position]
            _go_down(tree, codes, k, above, reached, kept, distances)
    return kept


@njit(allocates=False)
def _prefetch_children(tree: Tree, kept: NDArray[np.int32]) -> int:
    """Prefetch the centres of the children of these vertices (-1: none); returns how many vertices have children."""
    parents = 0
    for vertex in kept:
        first, children = tree.families[vertex, 0], tree.families[vertex, 1]
        if vertex >= 0 and children:
            parents += 1
            for child in range(first, first + children - 1, 2):  # two to a line of the cache
                prefetch(tree.centres, child, 0)
            prefetch(tree.centres, first + children - 1, CODE_WORDS - 1)
    return parents


@njit(allocates=False)
def _go_down(
    tree: Tree,
    codes: CodeWords,
    k: int,
    above: NDArray[np.int32],
    reached: NDArray[np.int32],
    kept: NDArray[np.int32],
    distances: NDArray[np.int32],
) -> None:
    """Replace the vertices that code k reached (-1 after the last) by the nearest of their children; leaves stay.

    The first entry follows the path of ``find_leaves``: only children of the first vertex may take it. The children of
    the other vertices follow it, sorted by distance.
    """
    found, beam = 0, above.shape[0]
    for position in range(beam):
        vertex = above[position]
        if vertex < 0:
            break
        first, children = tree.families[vertex, 0], tree.families[vertex, 1]
        for candidate in range(first, first + children) if children else range(vertex, vertex + 1):
            distance = _distance(codes, k, tree.centres, candidate) if children else reached[position]
            if found < beam:
                found += 1
            elif distance >= distances[k, beam - 1]:
                continue
            place, foremost = found - 1, min(position, 1)
            while place > foremost and distances[k, place - 1] > distance:
                kept[k, place], distances[k, place] = kept[k, place - 1], distances[k, place - 1]
                place -= 1
            kept[k, place], distances[k, place] = candidate, distance


@njit
def grow_tree(codes: CodeWords, shape: TreeShape, seed: np.uint64) -> Tree:
    """Train a tree on codes (N, 4): split them level by level. ``members`` keeps the codes of a vertex together."""
    most = 1 + shape.branching * (1 + shape.depth * (codes.shape[0] // shape.smallest_split))
    centres = np.zeros((most, CODE_WORDS), np.uint64)
    families = np.zeros((most, 2), np.int32)
    begin, end, level = np.zeros(most, np.int64), np.zeros(most, np.int64), np.zeros(most, np.int64)
    members, sorted_members = np.arange(codes.shape[0]), np.empty(codes.shape[0], np.int64)
    end[0], used, vertex = codes.shape[0], 1, 0
    state = np.array([seed], np.uint64)
    while vertex < used:
        low, high = begin[vertex], end[vertex]
        if level[vertex] < shape.depth and high - low >= shape.smallest_split:
            found, labels = k_means(codes[members[low:high]], shape, state)
            if found.shape[0] > 1:
                families[vertex, 0], families[vertex, 1] = used, found.shape[0]
                bound = low
                for label in range(found.shape[0]):
                    begin[used], level[used] = bound, level[vertex] + 1
                    for k in range(low, high):
                        if labels[k - low] == label:
                            sorted_members[bound] = members[k]
                            bound += 1
                    end[used] = bound
                    assign(centres[used], found[label])
                    used += 1
                assign(members[low:high], sorted_members[low:high])
        vertex += 1
    return Tree(centres[:used].copy(), families[:used].copy())


@njit
def k_means(codes: CodeWords, shape: TreeShape, state: NDArray[np.uint64]) -> tuple[CodeWords, NDArray[np.int64]]:
    """Cluster codes (N, 4) by Hamming distance: centres (C, 4), none without members, and the cluster of each, (N,).

    At most ``shape.branching`` clusters, after at most ``shape.iterations`` rounds. Advances the random ``state`` (1,).
    """
    centres = _seed_centres(codes, shape.branching, state)
    labels = np.full(codes.shape[0], -1, np.int64)
    for _ in range(shape.iterations):
        changed = _assign(codes, centres, labels)
        if not changed:
            break
        centres = _majorities(codes, labels, centres.shape[0])
    _assign(codes, centres, labels)
    sizes = np.bincount(labels, minlength=centres.shape[0])
    return centres[sizes > 0], (np.cumsum(sizes > 0) - 1)[labels]


@njit(allocates=False)
def _distance(codes: CodeWords, k: int, centres: CodeWords, vertex: int) -> Any:
    """Hamming distance of code k and a centre. Takes indices, because slicing rows costs more than comparing them."""
    bits = popcount(codes[k, 0] ^ centres[vertex, 0]) + popcount(codes[k, 1] ^ centres[vertex, 1])
    bits += popcount(codes[k, 2] ^ centres[vertex, 2]) + popcount(codes[k, 3] ^ centres[vertex, 3])
    return np.int32(bits)


@njit(allocates=False)
def _nearest(codes: CodeWords, k: int, centres: CodeWords, first: int, end: int) -> Any:
    """Index of the centre nearest to code k, from ``first`` (included) to ``end`` (excluded)."""
    best, best_distance = first, np.int32(CODE_BITS + 1)
    for candidate in range(first, end):
        distance = _distance(codes, k, centres, candidate)
        if distance < best_distance:
            best, best_distance = candidate, distance
    return best


@njit(allocates=False)
def _assign(codes: CodeWords, centres: CodeWords, labels: NDArray[np.int64]) -> int:
    changed = 0
    for k in range(codes.shape[0]):
        label = _nearest(codes, k, centres, 0, centres.shape[0])
        changed += label != labels[k]
        labels[k] = label
    return changed


@njit
def _seed_centres(codes: CodeWords, branching: int, state: NDArray[np.uint64]) -> CodeWords:
    """k-means++ (Arthur and Vassilvitskii 2007): draw each next centre by its squared distance to those so far."""
    centres = np.empty((branching, CODE_WORDS), np.uint64)
    assign(centres[0], codes[int(_uniform(state) * codes.shape[0])])
    nearest = np.full(codes.shape[0], CODE_BITS + 1, np.int64)
    count = 1
    while count < branching:
        for index in range(codes.shape[0]):
            nearest[index] = min(nearest[index], np.int64(_distance(codes, index, centres, count - 1)))
        reach = np.cumsum(nearest * nearest)
        if reach[-1] == 0:
            break
        drawn = np.searchsorted(reach, int(_uniform(state) * reach[-1]), side="right")
        assign(centres[count], codes[drawn])
        count += 1
    return centres[:count]


@njit
def _majorities(codes: CodeWords, labels: NDArray[np.int64], count: int) -> CodeWords:
    """Majority of every bit in every cluster; 0 in a tie and in a cluster without members.

    Counts the ones of 64 bits at once (bit-sliced counters): plane p holds bit p of each of the 64 counts.
    """
    planes = np.zeros((count, CODE_WORDS, _MOST_PLANES), np.uint64)
    for k in range(codes.shape[0]):
        for word in range(CODE_WORDS):
            plane, carry = 0, codes[k, word]
            while carry:
                kept = planes[labels[k], word, plane]
                planes[labels[k], word, plane] = kept ^ carry
                carry &= kept
                plane += 1
    half = np.bincount(labels, minlength=count) // 2
    centres = np.zeros((count, CODE_WORDS), np.uint64)
    for label in range(count):
        for word in range(CODE_WORDS):
            equal = ~np.uint64(0)  # counts whose higher bits are those of half the cluster
            for plane in range(_MOST_PLANES - 1, -1, -1):
                ones = planes[label, word, plane]
                if (half[label] >> plane) & 1:
                    equal &= ones
                else:
                    centres[label, word] |= equal & ones
                    equal &= ~ones
    return centres


@njit(allocates=False)
def _uniform(state: NDArray[np.uint64]) -> float:
    """Next number in [0, 1) of splitmix64 (Steele, Lea, Flood 2014), so that the tree depends on the seed alone."""
    state[0] += np.uint64(0x9E3779B97F4A7C15)
    z = state[0]
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    z ^= z >> np.uint64(31)
    return float(z >> np.uint64(11)) * 2.0**-53
