"""Nearest neighbours among descriptors of two images, binary or float."""

import numpy as np
from numpy.typing import NDArray

from fcslam.features.codes import hamming_matrix

Descriptors = NDArray[np.uint8] | NDArray[np.float32]
"""Codes (N, 32) uint8, compared by Hamming distance, or numbers (N, D) float32, by Euclidean distance."""
Rows = NDArray[np.int64]


def nearest_neighbours(a: Descriptors, b: Descriptors) -> tuple[Rows, Rows]:
    """Find the nearest neighbour in ``b`` (M, D) of each of ``a`` (N, D), shape (N,), and vice versa, shape (M,).

    Ties take the first one. Both sets hold at least one descriptor.
    """
    distances = _distances(a, b)
    return distances.argmin(axis=1), distances.argmin(axis=0)


def mutual_pairs(to_b: Rows, to_a: Rows) -> Rows:
    """Pairs of mutual nearest neighbours (K, 2) from both results of ``nearest_neighbours``, (N,) and (M,)."""
    rows = np.flatnonzero(to_a[to_b] == np.arange(len(to_b)))
    return np.column_stack((rows, to_b[rows]))


def _distances(a: Descriptors, b: Descriptors) -> NDArray[np.uint16] | NDArray[np.float64]:
    """Hamming distances or squared Euclidean distances, shape (N, M)."""
    if a.dtype == np.uint8:
        return hamming_matrix(a, b)  # type: ignore[arg-type]
    first, second = a.astype(np.float64), b.astype(np.float64)
    squares: NDArray[np.float64] = np.sum(first**2, axis=1)[:, None] + np.sum(second**2, axis=1)
    return squares - 2.0 * first @ second.T
