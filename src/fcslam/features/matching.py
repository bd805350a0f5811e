"""Nearest neighbours among descriptors of two images, whatever these are made of."""

import numpy as np
from numpy.typing import NDArray

from fcslam.features.codes import hamming_matrix

Descriptors = NDArray[np.uint8] | NDArray[np.float32]
"""Codes (N, 32) uint8, compared by Hamming distance, or numbers (N, D) float32, by Euclidean distance."""
Rows = NDArray[np.int64]


def nearest_neighbours(a: Descriptors, b: Descriptors) -> tuple[Rows, Rows]:
    """Row in ``b`` (M, D) of the nearest to each of ``a`` (N, D), shape (N,), and the other way round, shape (M,).

    Of equally near ones the first counts. Both sets hold at least one descriptor.
    """
    distances = _distances(a, b)
    return distances.argmin(axis=1), distances.argmin(axis=0)


def mutual_pairs(to_b: Rows, to_a: Rows) -> Rows:
    """Rows of those that are each other's nearest neighbours, shape (K, 2), from what ``nearest_neighbours`` gives."""
    rows = np.flatnonzero(to_a[to_b] == np.arange(len(to_b)))
    return np.column_stack((rows, to_b[rows]))


def _distances(a: Descriptors, b: Descriptors) -> NDArray[np.uint16] | NDArray[np.float64]:
    """Hamming distances, or squares of Euclidean ones, shape (N, M)."""
    if a.dtype == np.uint8:
        return hamming_matrix(a, b)  # type: ignore[arg-type]
    first, second = a.astype(np.float64), b.astype(np.float64)
    squares: NDArray[np.float64] = np.sum(first**2, axis=1)[:, None] + np.sum(second**2, axis=1)
    return squares - 2.0 * first @ second.T
