"""The inverted index: all stored descriptors by word, in chains of blocks, and by place.

The blocks hold the codes themselves. A query compares some hundred codes of one word, and codes stored by place would
cost a cache miss each. For the same reason a block holds everything about its entries.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fcslam.compiled import njit
from fcslam.features.codes import CODE_WORDS, CodeWords
from fcslam.places.prefetch import prefetch
from fcslam.records import FloatArray, Scalar

BLOCK = 8
"""Entries of a block. More waste memory in small words, fewer cost more jumps between blocks."""

GROWTH_FACTOR = 1.06
"""Factor by which arrays grow when they are full."""

ROWS = 2 * CODE_WORDS * BLOCK
"""Offset in a block's ``numbers``: row of the place of each entry."""
OLDER = ROWS + BLOCK
"""Offset in a block's ``numbers``: the previous block of the chain, -1 for none."""
_INDICES = OLDER + 2
"""Offset in a block's ``numbers``: index of each entry among the descriptors of its place."""
_BLOCK_WORDS = (_INDICES + BLOCK) // 2


class Entries(NamedTuple):
    """The arrays of the postings for compiled code. A leaf's vertex number stands for a word, a row for a place."""

    heads: NDArray[np.int32]
    """Shape (V, 2): newest block of each leaf, -1 for none (older blocks of the chain are full); descriptors of it."""
    documents: NDArray[np.int32]
    """Shape (V,): places with a descriptor in the leaf (document frequency)."""
    blocks: NDArray[np.uint64]
    """Shape (B, _BLOCK_WORDS): first the codes, entry by entry."""
    numbers: NDArray[np.int32]
    """Shape (B, 2 * _BLOCK_WORDS): the same memory as 32-bit numbers, at ``ROWS``, ``OLDER`` and ``_INDICES``."""
    free: NDArray[np.int64]
    """Shape (2,): first block of the chain of free blocks, -1 for none; first block that was never used."""
    starts: NDArray[np.int64]
    """Shape (R,): first descriptor of the place in ``leaves``."""
    counts: NDArray[np.int32]
    """Shape (R,): descriptors of the place; -1 if it was forgotten."""
    leaves: NDArray[np.int32]
    """Shape (D,): the leaf of every descriptor, place by place."""
    log_documents: FloatArray
    """Shape (R,): sum of ln(documents) over a place's descriptors. A place of n descriptors has the L1 norm n ln(N)
    minus this sum, for any N. Shape (0,) if no norms are kept."""

    @property
    def sizes(self) -> NDArray[np.int32]:
        """Shape (V,): descriptors of each leaf."""
        return self.heads[:, 1]


class Content(NamedTuple):
    """The descriptors of some leaves, in the order of places."""

    rows: NDArray[np.int32]
    """Shape (K,)."""
    indices: NDArray[np.int32]
    """Shape (K,)."""
    codes: CodeWords
    """Shape (K, 4)."""


class Postings:
    """Owner of the entries; its arrays grow on demand."""

    def __init__(self, vertices: int, has_norms: bool) -> None:
        """``has_norms``: whether to maintain the L1 norms of the places, which every new place changes."""
        self._has_norms = has_norms
        self.entries = Entries(
            _heads(vertices),
            np.zeros(vertices, np.int32),
            np.empty((0, _BLOCK_WORDS), np.uint64),
            np.empty((0, 2 * _BLOCK_WORDS), np.int32),
            np.array([-1, 0]),
            np.empty(0, np.int64),
            np.empty(0, np.int32),
            np.empty(0, np.int32),
            np.empty(0),
        )
        self.row_count = 0
        self.descriptor_count = 0
        """Descriptors of all rows, including those of forgotten places."""

    def add(self, codes: CodeWords, leaves: NDArray[np.int32]) -> int:
        """Add a place with its codes (N, 4) in these leaves (N,); returns its row."""
        row, begin = self.row_count, self.descriptor_count
        self._make_room(blocks=len(codes), rows=1, descriptors=len(codes))
        entries = self.entries
        entries.starts[row], entries.counts[row] = begin, len(codes)
        self.row_count, self.descriptor_count = row + 1, begin + len(codes)
        _enter(entries, row, codes, leaves)
        return row

    def fill(self, codes: CodeWords, leaves: NDArray[np.int32], counts: NDArray[np.int32]) -> None:
        """Add many places to empty postings: codes (M, 4) and leaves (M,) place by place, ``counts`` (P,) of each."""
        sizes = np.bincount(leaves, minlength=len(self.entries.heads))
        blocks = -(-sizes // BLOCK)
        ends = np.cumsum(blocks)
        self._make_room(blocks=int(ends[-1]), rows=len(counts), descriptors=len(codes))
        self.row_count, self.descriptor_count = len(counts), len(codes)
        entries = self.entries
        entries.heads[:, 0], entries.heads[:, 1] = np.where(sizes, ends - 1, -1), sizes
        entries.free[1] = ends[-1]
        entries.numbers[: ends[-1], OLDER] = np.arange(-1, ends[-1] - 1)
        entries.numbers[(ends - blocks)[sizes > 0], OLDER] = -1
        entries.counts[: len(counts)], entries.leaves[: len(codes)] = counts, leaves
        entries.starts[: len(counts)] = np.cumsum(counts) - counts
        _fill(entries, len(counts), codes, (ends - blocks) * BLOCK)

    def forget(self, row: int) -> NDArray[np.int32]:
        """Remove a place; returns its distinct leaves, shape (L,)."""
        leaves = np.unique(self.leaves(row))
        _remove(self.entries, leaves, row)
        self.entries.counts[row] = -1
        return leaves

    def leaves(self, row: int) -> NDArray[np.int32]:
        """The leaf of every descriptor of a place, shape (N,)."""
        begin = self.entries.starts[row]
        return self.entries.leaves[begin : begin + self.entries.counts[row]]

    def content(self, leaves: Sequence[int]) -> Content:
        """The descriptors of some leaves."""
        numbers = np.array(leaves, np.int32)
        size = int(self.entries.sizes[numbers].sum())
        content = Content(np.empty(size, np.int32), np.empty(size, np.int32), np.empty((size, CODE_WORDS), np.uint64))
        _read(self.entries, numbers, content)
        order = np.lexsort((content.indices, content.rows))
        return Content(content.rows[order], content.indices[order], content.codes[order])

    def move(self, leaves: Sequence[int], content: Content, targets: NDArray[np.int32]) -> None:
        """Move the ``content`` of ``leaves`` to other leaves: ``targets`` (K,), one for each entry."""
        receiving = np.unique(targets)
        self._make_room(blocks=len(targets) // BLOCK + len(receiving))
        _move(self.entries, np.array(leaves, np.int32), content, targets, receiving)

    def grow_vertices(self, vertices: int) -> None:
        """Make room for ``vertices`` vertices of the tree."""
        entries = self.entries
        before = len(entries.heads)
        if vertices > before:
            length = max(vertices, int(GROWTH_FACTOR * before))
            heads, documents = grown_rows(entries.heads, length), grown_rows(entries.documents, length)
            heads[before:], documents[before:] = _heads(length - before), 0
            self.entries = entries._replace(heads=heads, documents=documents)

    def gather(self, rows: NDArray[np.int64]) -> CodeWords:
        """Codes (M, 4) of the places ``rows`` (P,), in ascending order of rows, place by place."""
        return self._gathered(rows, np.arange(len(self.entries.heads)))

    def codes(self, row: int) -> CodeWords:
        """Codes (N, 4) of a place."""
        return self._gathered(np.array([row]), np.unique(self.leaves(row)).astype(np.int64))

    def _gathered(self, rows: NDArray[np.int64], leaves: NDArray[np.int64]) -> CodeWords:
        """As ``gather``, from the ``leaves`` (L,) that hold them."""
        begins = np.full(self.row_count, -1, np.int64)
        counts = self.entries.counts[rows]
        begins[rows] = np.cumsum(counts) - counts
        codes = np.empty((int(counts.sum()), CODE_WORDS), np.uint64)
        _gather(self.entries, leaves, begins, codes)
        return codes

    def _make_room(self, blocks: int, rows: int = 0, descriptors: int = 0) -> None:
        entries = self.entries
        block_count = int(entries.free[1]) + blocks
        if block_count > len(entries.blocks):
            grown = grown_rows(entries.blocks, max(block_count, int(GROWTH_FACTOR * len(entries.blocks))))
            entries = entries._replace(blocks=grown, numbers=grown.view(np.int32))
        if self.row_count + rows > len(entries.starts):
            length = max(self.row_count + rows, int(GROWTH_FACTOR * len(entries.starts)), 64)
            norms = grown_rows(entries.log_documents, length) if self._has_norms else entries.log_documents
            starts, counts = grown_rows(entries.starts, length), grown_rows(entries.counts, length)
            entries = entries._replace(starts=starts, counts=counts, log_documents=norms)
        if self.descriptor_count + descriptors > len(entries.leaves):
            length = max(self.descriptor_count + descriptors, int(GROWTH_FACTOR * len(entries.leaves)))
            entries = entries._replace(leaves=grown_rows(entries.leaves, length))
        self.entries = entries


def grown_rows(array: NDArray[Scalar], length: int) -> NDArray[Scalar]:
    """Grow ``array`` (N, ...) to shape (length, ...); the caller must not use the old array or a view of it.

    Large arrays grow in place: the system remaps their pages (mremap), so no new place waits for a copy of gigabytes.
    """
    if not (array.flags.owndata and array.flags.writeable):
        array = array.copy()
    array.resize((length, *array.shape[1:]), refcheck=False)
    return array


def _heads(vertices: int) -> NDArray[np.int32]:
    """``Entries.heads`` of empty leaves."""
    return np.tile(np.array([-1, 0], np.int32), (vertices, 1))


@njit(allocates=False)
def newest_block(entries: Entries, leaf: int) -> tuple[int, int]:
    """The newest block of a leaf, -1 for none, and the number of its entries."""
    return entries.heads[leaf, 0], (entries.heads[leaf, 1] - 1) % BLOCK + 1


@njit(allocates=False)
def prefetch_block(entries: Entries, block: int) -> None:
    """Prefetch the part of a block that a query reads; blocks are not aligned to cache lines."""
    for number in range(0, OLDER, 16):  # numbers in a cache line
        prefetch(entries.numbers, block, number)
    prefetch(entries.numbers, block, OLDER)


@njit
def _enter(entries: Entries, row: int, codes: CodeWords, leaves: NDArray[np.int32]) -> None:
    """Append a new place's descriptors and update the norms of the other places."""
    for leaf in leaves:
        prefetch(entries.heads, leaf, 0)
    for leaf in leaves:
        if entries.heads[leaf, 0] >= 0:
            prefetch_block(entries, entries.heads[leaf, 0])
    norms = entries.log_documents
    for index in range(codes.shape[0]):
        leaf = leaves[index]
        if _append(entries, leaf, row, index, codes, index):
            before = entries.documents[leaf] - 1
            if before:
                _shift(entries, leaf, np.log((before + 1) / before), row)
    if len(norms):
        norms[row] = np.log(entries.documents[leaves]).sum()


@njit
def _fill(entries: Entries, places: int, codes: CodeWords, first: NDArray[np.int64]) -> None:
    """Write all entries. ``first`` (V,): position of each leaf's next entry, in entries; it is advanced."""
    latest = np.full(first.shape[0], -1, np.int32)
    k = 0
    for row in range(places):
        for index in range(entries.counts[row]):
            leaf = entries.leaves[k]
            _put(entries, first[leaf] // BLOCK, first[leaf] % BLOCK, row, index, codes, k)
            first[leaf] += 1
            entries.documents[leaf] += latest[leaf] != row
            latest[leaf] = row
            k += 1
    if len(entries.log_documents):
        log_documents = np.log(np.maximum(entries.documents, 1))
        for row in range(places):
            begin = entries.starts[row]
            entries.log_documents[row] = log_documents[entries.leaves[begin : begin + entries.counts[row]]].sum()


@njit(allocates=False)
def _put(entries: Entries, block: int, place: int, row: int, index: int, codes: CodeWords, k: int) -> None:
    """Write an entry: descriptor ``index`` of a row, with code k of ``codes``."""
    entries.numbers[block, ROWS + place], entries.numbers[block, _INDICES + place] = row, index
    for word in range(CODE_WORDS):
        entries.blocks[block, CODE_WORDS * place + word] = codes[k, word]


@njit(allocates=False)
def _append(entries: Entries, leaf: int, row: int, index: int, codes: CodeWords, k: int) -> Any:
    """Append an entry; returns whether it is the first of its place in the leaf. A place's entries come in a row."""
    block, filled = newest_block(entries, leaf)
    is_new = block < 0 or entries.numbers[block, ROWS + filled - 1] != row
    if block < 0 or filled == BLOCK:
        older, block, filled = block, entries.free[0], 0
        if block >= 0:
            entries.free[0] = entries.numbers[block, OLDER]
        else:
            block = entries.free[1]
            entries.free[1] += 1
        entries.numbers[block, OLDER] = older
        entries.heads[leaf, 0] = block
    _put(entries, block, filled, row, index, codes, k)
    entries.heads[leaf, 1] += 1
    entries.documents[leaf] += is_new
    entries.leaves[entries.starts[row] + index] = leaf
    return is_new


@njit(allocates=False)
def _shift(entries: Entries, leaf: int, change: float, but: int) -> None:
    """Add ``change`` to ``log_documents`` for every descriptor in a leaf, except those of row ``but``."""
    if not len(entries.log_documents):
        return
    block, filled = newest_block(entries, leaf)
    while block >= 0:
        for row in entries.numbers[block, ROWS : ROWS + filled]:
            if row != but:
                entries.log_documents[row] += change
        block, filled = entries.numbers[block, OLDER], BLOCK


@njit(allocates=False)
def _remove(entries: Entries, leaves: NDArray[np.int32], row: int) -> None:
    """Remove the entries of a row, from the end, so that the last entry, which fills each gap, is one that stays."""
    for leaf in leaves:
        block, filled = newest_block(entries, leaf)
        while block >= 0:
            older = entries.numbers[block, OLDER]
            for place in range(filled - 1, -1, -1):
                if entries.numbers[block, ROWS + place] == row:
                    _drop(entries, leaf, block, place)
            block, filled = older, BLOCK
        entries.documents[leaf] -= 1
        left = entries.documents[leaf]
        if left:
            _shift(entries, leaf, np.log(left / (left + 1)), -1)


@njit(allocates=False)
def _drop(entries: Entries, leaf: int, block: int, place: int) -> None:
    last, filled = newest_block(entries, leaf)
    row, index = entries.numbers[last, ROWS + filled - 1], entries.numbers[last, _INDICES + filled - 1]
    code = entries.blocks[last : last + 1, CODE_WORDS * (filled - 1) : CODE_WORDS * filled]
    _put(entries, block, place, row, index, code, 0)
    entries.heads[leaf, 1] -= 1
    if filled == 1:
        entries.heads[leaf, 0] = entries.numbers[last, OLDER]
        entries.numbers[last, OLDER] = entries.free[0]
        entries.free[0] = last


@njit(allocates=False)
def _read(entries: Entries, leaves: NDArray[np.int32], content: Content) -> None:
    count = 0
    for leaf in leaves:
        block, filled = newest_block(entries, leaf)
        while block >= 0:
            for place in range(filled):
                content.rows[count] = entries.numbers[block, ROWS + place]
                content.indices[count] = entries.numbers[block, _INDICES + place]
                for word in range(CODE_WORDS):
                    content.codes[count, word] = entries.blocks[block, CODE_WORDS * place + word]
                count += 1
            block, filled = entries.numbers[block, OLDER], BLOCK


@njit(allocates=False)
def _move(
    entries: Entries,
    leaves: NDArray[np.int32],
    content: Content,
    targets: NDArray[np.int32],
    receiving: NDArray[np.int32],
) -> None:
    for leaf in leaves:
        if entries.heads[leaf, 1]:
            _shift(entries, leaf, -np.log(entries.documents[leaf]), -1)
        _clear(entries, leaf)
    for k in range(targets.shape[0]):
        _append(entries, targets[k], content.rows[k], content.indices[k], content.codes, k)
    for leaf in receiving:
        _shift(entries, leaf, np.log(entries.documents[leaf]), -1)


@njit(allocates=False)
def _gather(entries: Entries, leaves: NDArray[np.int64], begins: NDArray[np.int64], codes: CodeWords) -> None:
    for leaf in leaves:
        block, filled = newest_block(entries, leaf)
        while block >= 0:
            for place in range(filled):
                begin = begins[entries.numbers[block, ROWS + place]]
                if begin >= 0:
                    target = begin + entries.numbers[block, _INDICES + place]
                    for word in range(CODE_WORDS):
                        codes[target, word] = entries.blocks[block, CODE_WORDS * place + word]
            block, filled = entries.numbers[block, OLDER], BLOCK


@njit(allocates=False)
def _clear(entries: Entries, leaf: int) -> None:
    block = entries.heads[leaf, 0]
    while block >= 0:
        older = entries.numbers[block, OLDER]
        entries.numbers[block, OLDER] = entries.free[0]
        entries.free[0] = block
        block = older
    entries.heads[leaf, 0], entries.heads[leaf, 1], entries.documents[leaf] = -1, 0, 0
