"""A k-means tree over binary codes: growing it and finding the leaves near a code, all compiled.

The centres are binary too: each bit is the majority of its cluster.
"""

from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from fcslam.features.codes import CODE_BITS, CODE_WORDS, CodeWords, hamming

_READ_CHILDREN = 8
"""Of a vertex: as many as most have."""


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
    first_child: NDArray[np.int32]
    """Shape (V,)."""
    child_count: NDArray[np.int32]
    """Shape (V,): 0 for a leaf."""


def bare_root() -> Tree:
    """A tree of one leaf."""
    return Tree(np.zeros((1, CODE_WORDS), np.uint64), np.zeros(1, np.int32), np.zeros(1, np.int32))


@njit(cache=True)
def descend(tree: Tree, codes: CodeWords) -> NDArray[np.int32]:
    """The leaf of every code (N, 4), shape (N,); of equally near children the first is taken."""
    reached = np.zeros(codes.shape[0], np.int32)
    while _read_children(tree, reached):
        for index in range(codes.shape[0]):
            if tree.child_count[reached[index]]:
                reached[index] = _nearest_child(tree, reached[index], codes[index])
    return reached


@njit(cache=True)
def near_leaves(tree: Tree, codes: CodeWords, beam: int) -> NDArray[np.int32]:
    """At most ``beam`` leaves whose centres are near each code (K, 4), the first of them that of ``descend``.

    Level by level the nearest ``beam`` vertices are kept, and always the one that ``descend`` passes. All codes go down
    abreast: what the next level needs is read for all of them at once, so that cache misses overlap.

    Returns:
        Shape (K, beam), -1 after the last one.
    """
    kept, distances = np.full((codes.shape[0], beam), -1, np.int32), np.zeros((codes.shape[0], beam), np.int64)
    kept[:, 0] = 0
    while _read_children(tree, kept):
        for k in range(codes.shape[0]):
            _go_down(tree, codes[k], kept[k], distances[k])
    return kept


@njit(cache=True)
def _read_children(tree: Tree, kept: NDArray[np.int32]) -> bool:
    """Bring the centres of the children of these vertices into the cache; tells whether there are any."""
    first, count = np.empty(kept.size, np.int32), 0
    for vertex in kept.flat:
        if vertex >= 0 and tree.child_count[vertex]:
            first[count] = tree.first_child[vertex]
            count += 1
    read = np.uint64(0)
    for child in first[:count]:
        for other in range(child, min(child + _READ_CHILDREN, tree.centres.shape[0]), 2):  # two to a line of the cache
            read |= tree.centres[other, 0]
    return bool(read >= np.uint64(0)) if count else False


@njit(cache=True)
def _go_down(tree: Tree, code: CodeWords, kept: NDArray[np.int32], distances: NDArray[np.int64]) -> None:
    """From the vertices kept (-1 after the last) to the nearest of their children; leaves stay."""
    above, reached = kept.copy(), distances.copy()
    kept[0] = _nearest_child(tree, above[0], code) if tree.child_count[above[0]] else above[0]
    found = 1  # the first place is for the way of ``descend``, the others are sorted by distance
    for position in range(above.shape[0]):
        vertex = above[position]
        if vertex < 0:
            break
        first, children = tree.first_child[vertex], tree.child_count[vertex]
        for candidate in range(first, first + children) if children else range(vertex, vertex + 1):
            if candidate == kept[0]:
                continue
            distance = np.int64(hamming(code, tree.centres[candidate])) if children else reached[position]
            if found == kept.shape[0] and (found == 1 or distance >= distances[found - 1]):
                continue
            found = min(found + 1, kept.shape[0])
            place = found - 1
            while place > 1 and distances[place - 1] > distance:
                kept[place], distances[place] = kept[place - 1], distances[place - 1]
                place -= 1
            kept[place], distances[place] = candidate, distance


@njit(cache=True)
def _nearest_child(tree: Tree, vertex: int, code: CodeWords) -> Any:
    first = tree.first_child[vertex]
    return first + _nearest(code, tree.centres[first : first + tree.child_count[vertex]])


@njit(cache=True)
def grow(codes: CodeWords, shape: TreeShape, seed: np.uint64) -> Tree:
    """Split the codes (N, 4) level by level; the codes of one vertex stay together in ``members``."""
    most = 1 + shape.branching * (1 + shape.depth * (codes.shape[0] // shape.smallest_split))
    centres = np.zeros((most, CODE_WORDS), np.uint64)
    first_child, child_count = np.zeros(most, np.int32), np.zeros(most, np.int32)
    begin, end, level = np.zeros(most, np.int64), np.zeros(most, np.int64), np.zeros(most, np.int64)
    members = np.arange(codes.shape[0])
    end[0], used, vertex = codes.shape[0], 1, 0
    state = np.array([seed], np.uint64)
    while vertex < used:
        low, high = begin[vertex], end[vertex]
        if level[vertex] < shape.depth and high - low >= shape.smallest_split:
            found, labels = k_means(codes[members[low:high]], shape, state)
            if found.shape[0] > 1:
                first_child[vertex], child_count[vertex] = used, found.shape[0]
                members[low:high] = members[low:high][np.argsort(labels, kind="mergesort")]
                bounds = low + np.cumsum(np.bincount(labels, minlength=found.shape[0]))
                children = slice(used, used + found.shape[0])
                centres[children], level[children], end[children] = found, level[vertex] + 1, bounds
                begin[used], begin[used + 1 : used + found.shape[0]] = low, bounds[:-1]
                used += found.shape[0]
        vertex += 1
    return Tree(centres[:used].copy(), first_child[:used].copy(), child_count[:used].copy())


@njit(cache=True)
def k_means(codes: CodeWords, shape: TreeShape, state: NDArray[np.uint64]) -> tuple[CodeWords, NDArray[np.int64]]:
    """At most ``shape.branching`` centres, none without members, and the centre nearest to every code.

    ``state``: shape (1,), of the random numbers; it moves on.
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


@njit(cache=True)
def _nearest(code: CodeWords, centres: CodeWords) -> int:
    best, best_distance = 0, np.uint64(CODE_BITS + 1)
    for index in range(centres.shape[0]):
        distance = hamming(code, centres[index])
        if distance < best_distance:
            best, best_distance = index, distance
    return best


@njit(cache=True)
def _assign(codes: CodeWords, centres: CodeWords, labels: NDArray[np.int64]) -> int:
    changed = 0
    for index in range(codes.shape[0]):
        label = _nearest(codes[index], centres)
        changed += label != labels[index]
        labels[index] = label
    return changed


@njit(cache=True)
def _seed_centres(codes: CodeWords, branching: int, state: NDArray[np.uint64]) -> CodeWords:
    """k-means++: the next centre is a code drawn by its squared distance to the centres so far."""
    centres = np.empty((branching, CODE_WORDS), np.uint64)
    centres[0] = codes[int(_uniform(state) * codes.shape[0])]
    nearest = np.full(codes.shape[0], CODE_BITS + 1, np.int64)
    count = 1
    while count < branching:
        for index in range(codes.shape[0]):
            nearest[index] = min(nearest[index], np.int64(hamming(codes[index], centres[count - 1])))
        reach = np.cumsum(nearest * nearest)
        if reach[-1] == 0:
            break
        centres[count] = codes[np.searchsorted(reach, int(_uniform(state) * reach[-1]), side="right")]
        count += 1
    return centres[:count]


@njit(cache=True)
def _majorities(codes: CodeWords, labels: NDArray[np.int64], count: int) -> CodeWords:
    """The majority of every bit in every cluster; a tie, as in a cluster without members, is 0."""
    ones = np.zeros((count, CODE_BITS), np.int32)
    sizes = np.bincount(labels, minlength=count)
    for index in range(codes.shape[0]):
        target = ones[labels[index]]
        for word in range(CODE_WORDS):
            bits = codes[index, word]
            for bit in range(64):
                target[word * 64 + bit] += np.int32((bits >> np.uint64(bit)) & np.uint64(1))
    centres = np.zeros((count, CODE_WORDS), np.uint64)
    for label in range(count):
        for bit in range(CODE_BITS):
            if 2 * ones[label, bit] > sizes[label]:
                centres[label, bit // 64] |= np.uint64(1) << np.uint64(bit % 64)
    return centres


@njit(cache=True)
def _uniform(state: NDArray[np.uint64]) -> float:
    """The next number in [0, 1) of splitmix64 (Steele, Lea, Flood 2014): the tree depends on the seed alone."""
    state[0] += np.uint64(0x9E3779B97F4A7C15)
    z = state[0]
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    z ^= z >> np.uint64(31)
    return float(z >> np.uint64(11)) * 2.0**-53
