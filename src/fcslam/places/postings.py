"""Where every stored descriptor is: by word, in blocks that a query reads in a row, and by place.

The codes themselves lie in the blocks, word by word: a query compares some hundred codes of one word, and codes that
lie place by place would cost a cache miss each.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from fcslam.features.codes import CODE_WORDS, CodeWords
from fcslam.records import FloatArray, Scalar

BLOCK = 8
"""Entries of a block: more waste memory in words of few descriptors, fewer cost jumps."""

GROWTH = 1.06
"""Of arrays that run out of room."""


class Entries(NamedTuple):
    """Postings as compiled code sees them. Words go by the number of their leaf in the tree, places by row."""

    newest: NDArray[np.int32]
    """Shape (V,): the block of each leaf that is being filled, -1 for none. All others of its chain are full."""
    sizes: NDArray[np.int32]
    """Shape (V,): descriptors of the leaf."""
    documents: NDArray[np.int32]
    """Shape (V,): places that have one."""
    older: NDArray[np.int32]
    """Shape (B,): the block before it in its chain, -1 for none."""
    rows: NDArray[np.int32]
    """Shape (B, BLOCK): whose descriptor it is."""
    indices: NDArray[np.int32]
    """Shape (B, BLOCK): which one of that place."""
    codes: CodeWords
    """Shape (B, BLOCK, 4)."""
    free: NDArray[np.int64]
    """Shape (2,): the first of the chain of unused blocks, -1 for none; from where on no block was ever used."""
    starts: NDArray[np.int64]
    """Shape (R,): where the place's descriptors begin in ``leaves``."""
    counts: NDArray[np.int32]
    """Shape (R,): how many they are; -1 for a place that was forgotten."""
    leaves: NDArray[np.int32]
    """Shape (D,): the leaf of every descriptor, place by place."""
    log_documents: FloatArray
    """Shape (R,): sum of ln(documents) over a place's descriptors. Its L1 norm is n ln(N) minus this, whatever N is."""


class Content(NamedTuple):
    """Descriptors that lie in some leaves, in the order of places."""

    rows: NDArray[np.int32]
    """Shape (K,)."""
    indices: NDArray[np.int32]
    """Shape (K,)."""
    codes: CodeWords
    """Shape (K, 4)."""


class Postings:
    """Entries with room for more."""

    def __init__(self, vertices: int) -> None:
        self.entries = Entries(
            np.full(vertices, -1, np.int32),
            np.zeros(vertices, np.int32),
            np.zeros(vertices, np.int32),
            np.empty(0, np.int32),
            np.empty((0, BLOCK), np.int32),
            np.empty((0, BLOCK), np.int32),
            np.empty((0, BLOCK, CODE_WORDS), np.uint64),
            np.array([-1, 0]),
            np.empty(0, np.int64),
            np.empty(0, np.int32),
            np.empty(0, np.int32),
            np.empty(0),
        )
        self.row_count = 0
        self.descriptor_count = 0
        """Of all rows, those of forgotten places included."""

    def add(self, codes: CodeWords, leaves: NDArray[np.int32]) -> int:
        """Enter a place with its codes (N, 4) in these leaves (N,); returns its row."""
        row, begin = self.row_count, self.descriptor_count
        self._make_room(blocks=len(codes), rows=1, descriptors=len(codes))
        entries = self.entries
        entries.starts[row], entries.counts[row], entries.log_documents[row] = begin, len(codes), 0.0
        self.row_count, self.descriptor_count = row + 1, begin + len(codes)
        _enter(entries, row, codes, leaves)
        return row

    def fill(self, codes: CodeWords, leaves: NDArray[np.int32], counts: NDArray[np.int32]) -> None:
        """Enter many places where there are none: codes (M, 4), leaves (M,) place by place, ``counts`` of each."""
        sizes = np.bincount(leaves, minlength=len(self.entries.newest))
        blocks = -(-sizes // BLOCK)
        ends = np.cumsum(blocks)
        self._make_room(blocks=int(ends[-1]), rows=len(counts), descriptors=len(codes))
        self.row_count, self.descriptor_count = len(counts), len(codes)
        entries = self.entries
        entries.sizes[: len(sizes)], entries.free[1] = sizes, ends[-1]
        entries.newest[: len(sizes)] = np.where(sizes, ends - 1, -1)
        entries.older[: ends[-1]] = np.arange(-1, ends[-1] - 1)
        entries.older[(ends - blocks)[sizes > 0]] = -1
        entries.counts[: len(counts)], entries.leaves[: len(codes)] = counts, leaves
        entries.starts[: len(counts)] = np.cumsum(counts) - counts
        _fill(entries, len(counts), codes, (ends - blocks) * BLOCK)

    def forget(self, row: int) -> NDArray[np.int32]:
        """Take a place out; returns the leaves that it was in."""
        leaves = np.unique(self.leaves(row))
        _remove(self.entries, leaves, row)
        self.entries.counts[row] = -1
        return leaves

    def leaves(self, row: int) -> NDArray[np.int32]:
        """The leaf of every descriptor of a place."""
        begin = self.entries.starts[row]
        return self.entries.leaves[begin : begin + self.entries.counts[row]]

    def content(self, leaves: Sequence[int]) -> Content:
        """What lies in some leaves."""
        numbers = np.array(leaves, np.int32)
        size = int(self.entries.sizes[numbers].sum())
        content = Content(np.empty(size, np.int32), np.empty(size, np.int32), np.empty((size, CODE_WORDS), np.uint64))
        _read(self.entries, numbers, content)
        order = np.lexsort((content.indices, content.rows))
        return Content(content.rows[order], content.indices[order], content.codes[order])

    def move(self, leaves: Sequence[int], content: Content, targets: NDArray[np.int32]) -> None:
        """Empty ``leaves``, whose ``content`` this is, into other ones: ``targets`` (K,), one for each entry."""
        receiving = np.unique(targets)
        self._make_room(blocks=len(targets) // BLOCK + len(receiving))
        _move(self.entries, np.array(leaves, np.int32), content, targets, receiving)

    def grow_vertices(self, vertices: int) -> None:
        """Make room for so many vertices of the tree."""
        entries = self.entries
        if vertices > len(entries.newest):
            length = max(vertices, int(GROWTH * len(entries.newest)))
            before = len(entries.newest)
            newest, sizes, documents = (longer(array, length) for array in entries[:3])
            newest[before:], sizes[before:], documents[before:] = -1, 0, 0
            self.entries = entries._replace(newest=newest, sizes=sizes, documents=documents)

    def gather(self, rows: NDArray[np.int64]) -> CodeWords:
        """Codes (M, 4) of these places, in ascending order of rows, place by place."""
        begins = np.full(self.row_count, -1, np.int64)
        counts = self.entries.counts[rows]
        begins[rows] = np.cumsum(counts) - counts
        codes = np.empty((int(counts.sum()), CODE_WORDS), np.uint64)
        _gather(self.entries, begins, codes)
        return codes

    def _make_room(self, blocks: int, rows: int = 0, descriptors: int = 0) -> None:
        entries = self.entries
        block_count = int(entries.free[1]) + blocks
        if block_count > len(entries.older):
            length = max(block_count, int(GROWTH * len(entries.older)))
            entries = entries._replace(
                older=longer(entries.older, length), rows=longer(entries.rows, length),
                indices=longer(entries.indices, length), codes=longer(entries.codes, length),
            )  # fmt: skip
        if self.row_count + rows > len(entries.starts):
            length = max(self.row_count + rows, int(GROWTH * len(entries.starts)), 64)
            entries = entries._replace(
                starts=longer(entries.starts, length), counts=longer(entries.counts, length),
                log_documents=longer(entries.log_documents, length),
            )  # fmt: skip
        if self.descriptor_count + descriptors > len(entries.leaves):
            length = max(self.descriptor_count + descriptors, int(GROWTH * len(entries.leaves)))
            entries = entries._replace(leaves=longer(entries.leaves, length))
        self.entries = entries


def longer(array: NDArray[Scalar], length: int) -> NDArray[Scalar]:
    """``array`` with room for ``length`` rows, those it had being kept; the array given is not to be used any more.

    Large arrays grow in place: the system maps their pages anew instead of copying them, so that no place that comes
    has to wait for gigabytes to move. Nothing may hold a view of the array.
    """
    if not (array.flags.owndata and array.flags.writeable):
        array = array.copy()
    array.resize((length, *array.shape[1:]), refcheck=False)
    return array


@njit(cache=True)
def block_size(entries: Entries, leaf: int) -> Any:
    """Entries in the newest block of a leaf that is not empty."""
    return (entries.sizes[leaf] - 1) % BLOCK + 1


@njit(cache=True)
def _enter(entries: Entries, row: int, codes: CodeWords, leaves: NDArray[np.int32]) -> None:
    """A new place's descriptors, and what it changes in the norms of others."""
    for index in range(codes.shape[0]):
        leaf = leaves[index]
        if _append(entries, leaf, row, index, codes[index]):
            before = entries.documents[leaf] - 1
            if before:
                _shift(entries, leaf, np.log((before + 1) / before), row)
        entries.log_documents[row] += np.log(entries.documents[leaf])


@njit(cache=True)
def _fill(entries: Entries, places: int, codes: CodeWords, first: NDArray[np.int64]) -> None:
    """``first`` (V,): where in the blocks, entry by entry, each leaf's descriptors begin; it moves on."""
    rows, indices = entries.rows.reshape(-1), entries.indices.reshape(-1)
    stored = entries.codes.reshape(-1, CODE_WORDS)
    latest = np.full(first.shape[0], -1, np.int32)
    k = 0
    for row in range(places):
        for index in range(entries.counts[row]):
            leaf = entries.leaves[k]
            target = first[leaf]
            first[leaf] += 1
            rows[target], indices[target] = row, index
            for word in range(CODE_WORDS):
                stored[target, word] = codes[k, word]
            entries.documents[leaf] += latest[leaf] != row
            latest[leaf] = row
            k += 1
    log_documents = np.log(np.maximum(entries.documents, 1))
    for row in range(places):
        begin = entries.starts[row]
        entries.log_documents[row] = log_documents[entries.leaves[begin : begin + entries.counts[row]]].sum()


@njit(cache=True)
def _append(entries: Entries, leaf: int, row: int, index: int, code: CodeWords) -> Any:
    """Tells whether the place is new in the leaf: its descriptors come one after the other."""
    place = entries.sizes[leaf] % BLOCK
    block = entries.newest[leaf]
    is_new = block < 0 or entries.rows[block, block_size(entries, leaf) - 1] != row
    if place == 0:
        block = entries.free[0]
        if block >= 0:
            entries.free[0] = entries.older[block]
        else:
            block = entries.free[1]
            entries.free[1] += 1
        entries.older[block] = entries.newest[leaf]
        entries.newest[leaf] = block
    entries.rows[block, place], entries.indices[block, place] = row, index
    entries.codes[block, place] = code
    entries.sizes[leaf] += 1
    entries.documents[leaf] += is_new
    entries.leaves[entries.starts[row] + index] = leaf
    return is_new


@njit(cache=True)
def _shift(entries: Entries, leaf: int, change: float, but: int) -> None:
    """Add to the ``log_documents`` of every descriptor in a leaf but those of one place."""
    block, filled = entries.newest[leaf], block_size(entries, leaf)
    while block >= 0:
        for place in range(filled):
            row = entries.rows[block, place]
            if row != but:
                entries.log_documents[row] += change
        block, filled = entries.older[block], BLOCK


@njit(cache=True)
def _remove(entries: Entries, leaves: NDArray[np.int32], row: int) -> None:
    """From the end to the beginning: the last entry, which fills each gap, is one that stays."""
    for leaf in leaves:
        block, place = entries.newest[leaf], block_size(entries, leaf)
        while block >= 0:
            older = entries.older[block]
            for k in range(place - 1, -1, -1):
                if entries.rows[block, k] == row:
                    _drop(entries, leaf, block, k)
            block, place = older, BLOCK
        entries.documents[leaf] -= 1
        left = entries.documents[leaf]
        if left:
            _shift(entries, leaf, np.log(left / (left + 1)), -1)


@njit(cache=True)
def _drop(entries: Entries, leaf: int, block: int, place: int) -> None:
    last, end = entries.newest[leaf], block_size(entries, leaf) - 1
    entries.rows[block, place], entries.indices[block, place] = entries.rows[last, end], entries.indices[last, end]
    entries.codes[block, place] = entries.codes[last, end]
    entries.sizes[leaf] -= 1
    if end == 0:
        entries.newest[leaf] = entries.older[last]
        entries.older[last] = entries.free[0]
        entries.free[0] = last


@njit(cache=True)
def _read(entries: Entries, leaves: NDArray[np.int32], content: Content) -> None:
    count = 0
    for leaf in leaves:
        block, filled = entries.newest[leaf], block_size(entries, leaf)
        while block >= 0:
            for place in range(filled):
                content.rows[count], content.indices[count] = entries.rows[block, place], entries.indices[block, place]
                content.codes[count] = entries.codes[block, place]
                count += 1
            block, filled = entries.older[block], BLOCK


@njit(cache=True)
def _move(
    entries: Entries,
    leaves: NDArray[np.int32],
    content: Content,
    targets: NDArray[np.int32],
    receiving: NDArray[np.int32],
) -> None:
    for leaf in leaves:
        if entries.sizes[leaf]:
            _shift(entries, leaf, -np.log(entries.documents[leaf]), -1)
        _clear(entries, leaf)
    for k in range(targets.shape[0]):
        _append(entries, targets[k], content.rows[k], content.indices[k], content.codes[k])
    for leaf in receiving:
        _shift(entries, leaf, np.log(entries.documents[leaf]), -1)


@njit(cache=True)
def _gather(entries: Entries, begins: NDArray[np.int64], codes: CodeWords) -> None:
    for leaf in range(entries.newest.shape[0]):
        block, filled = entries.newest[leaf], block_size(entries, leaf)
        while block >= 0:
            for place in range(filled):
                row = entries.rows[block, place]
                if begins[row] >= 0:
                    target = begins[row] + entries.indices[block, place]
                    for word in range(CODE_WORDS):
                        codes[target, word] = entries.codes[block, place, word]
            block, filled = entries.older[block], BLOCK


@njit(cache=True)
def _clear(entries: Entries, leaf: int) -> None:
    block = entries.newest[leaf]
    while block >= 0:
        older = entries.older[block]
        entries.older[block] = entries.free[0]
        entries.free[0] = block
        block = older
    entries.newest[leaf], entries.sizes[leaf], entries.documents[leaf] = -1, 0, 0
