"""Which places may be forgotten where a robot has stored very many."""

import numpy as np
from numpy.typing import NDArray

from fcslam.records import FloatArray


def crowded_out(positions_m: FloatArray, side_m: float, most: int) -> NDArray[np.int64]:
    """All but the newest ``most`` places in the square of the newest one, which is one of them.

    Asked after every new place, each square keeps its newest ``most`` places, and all of them if they are fewer: as
    long as places stay where they are, memory is bounded by the area that a robot drives in and not by how long it
    drives, and no area loses its last place. Squares tell that, and discs around the newest place would not: on its
    way a robot would sweep away what it had stored behind it.

    Args:
        positions_m: shape (N, 2), the oldest first, the newest last.
        side_m: of the squares, which lie side by side; the origin, where a robot starts, is the middle of one.
        most: 1 or more, so that the newest always stays.

    Returns:
        Rows of ``positions_m``; none if there is room.
    """
    if len(positions_m) <= most:
        return np.empty(0, np.int64)
    squares = np.floor(positions_m / side_m + 0.5)
    return np.flatnonzero((squares == squares[-1]).all(axis=1))[:-most]
