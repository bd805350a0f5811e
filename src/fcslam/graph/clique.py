"""Maximum clique: exact branch and bound with a greedy colouring bound, sets as the bits of one integer.

Tomita and Kameda 2007 (MCR): a clique takes at most one vertex of each colour class, so a branch with too few
colours to beat the best clique is pruned. Vertices are ordered by falling degree, then by number: the result is
deterministic.
"""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

NODE_BUDGET = 50_000
"""Largest number of branches; after them the best clique so far is returned as not proven ..."""

VERTEX_BUDGET = 80 * NODE_BUDGET
"""... and of branches times vertices: a branch of a large graph takes longer."""


def maximum_clique(adjacent: NDArray[np.bool_], node_budget: int = NODE_BUDGET) -> tuple[list[int], bool]:
    """Find the largest clique of a graph.

    Args:
        adjacent: adjacency matrix, shape (K, K), symmetric; the diagonal does not count.
        node_budget: largest number of branches.

    Returns:
        The vertices of the largest clique in ascending order, and whether that is proven; if the budget ran out, the
        largest one found, at least the greedy one.
    """
    matrix = np.asarray(adjacent, dtype=bool)
    if matrix.ndim != 2 or matrix.shape[0] != matrix.shape[1] or (matrix != matrix.T).any():
        raise ValueError(f"an adjacency matrix is square and symmetric; this one has shape {matrix.shape}")
    size = len(matrix)
    if size == 0:
        return [], True
    matrix = matrix & ~np.eye(size, dtype=bool)
    order = np.argsort(-matrix.sum(axis=1), kind="stable")
    neighbours = [_to_bits(row) for row in matrix[np.ix_(order, order)]]
    best, exact = _search(neighbours, min(node_budget, VERTEX_BUDGET // size))
    return sorted(int(order[vertex]) for vertex in _bits(best)), exact


def _search(neighbours: list[int], node_budget: int) -> tuple[int, bool]:
    """Largest clique as bits, and whether it is proven. An explicit stack: large cliques exceed Python's recursion."""
    best, best_size, nodes = 0, 0, 0
    everything = (1 << len(neighbours)) - 1
    stack: list[tuple[int, int, list[tuple[int, int]]]] = [(0, everything, _coloured(everything, neighbours))]
    while stack:
        clique, candidates, branches = stack.pop()
        if not branches or clique.bit_count() + branches[-1][1] <= best_size:
            continue
        nodes += 1
        if nodes > node_budget + len(neighbours):
            return best, False
        vertex, _ = branches.pop()
        stack.append((clique, candidates & ~(1 << vertex), branches))
        grown, left = clique | (1 << vertex), candidates & neighbours[vertex]
        if grown.bit_count() > best_size:
            best, best_size = grown, grown.bit_count()
        if left:
            stack.append((grown, left, _coloured(left, neighbours)))
    return best, True


def _coloured(vertices: int, neighbours: list[int]) -> list[tuple[int, int]]:
    """(vertex, colours used so far), ascending: no clique among the vertices so far has more members than colours."""
    result: list[tuple[int, int]] = []
    colour = 0
    while vertices:
        colour += 1
        free = vertices
        while free:
            vertex = (free & -free).bit_length() - 1
            result.append((vertex, colour))
            vertices &= ~(1 << vertex)
            free &= ~(neighbours[vertex] | (1 << vertex))
    return result


def _to_bits(row: NDArray[np.bool_]) -> int:
    return int.from_bytes(np.packbits(row, bitorder="little").tobytes(), "little")


def _bits(vertices: int) -> Iterator[int]:
    while vertices:
        yield (vertices & -vertices).bit_length() - 1
        vertices &= vertices - 1
