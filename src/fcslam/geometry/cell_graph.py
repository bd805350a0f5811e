"""The cells of a grid as a graph, in which shortest paths are searched."""

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from fcslam.records import FloatArray


def cell_graph(cells: NDArray[np.bool_], side_m: float, price: FloatArray) -> csr_array:
    """Costs (N, N) of the steps between neighbours among the N cells that are set, also across corners.

    ``price`` of a metre in each cell has the shape of ``cells``.
    """
    numbers = np.cumsum(cells).reshape(cells.shape) - 1
    starts, ends, costs = [], [], []
    height, width = cells.shape
    for row, column in ((0, 1), (1, 0), (1, 1), (1, -1)):
        here = slice(0, height - row), slice(max(0, -column), width - max(0, column))
        there = slice(row, None), slice(max(0, column), width + min(0, column))
        both = cells[here] & cells[there]
        starts.append(numbers[here][both])
        ends.append(numbers[there][both])
        length_m = side_m * float(np.hypot(row, column))
        costs.append(0.5 * length_m * (price[here][both] + price[there][both]))
    ways = np.concatenate(starts + ends), np.concatenate(ends + starts)
    return csr_array((np.concatenate(costs + costs), ways), shape=(int(cells.sum()),) * 2)
