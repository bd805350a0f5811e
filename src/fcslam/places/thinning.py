"""Which places may be forgotten where a robot has stored very many."""

import numpy as np
from numpy.typing import NDArray

from fcslam.records import FloatArray


def crowded_out(positions_m: FloatArray, radius_m: float, most: int) -> NDArray[np.int64]:
    """All but the newest ``most`` places within ``radius_m`` of the newest one, which is one of them.

    Asked after every new place, no disc of half the radius ever holds more than ``most``: as long as places stay where
    they are, memory is bounded by the area that a robot drives in and not by how long it drives.

    Args:
        positions_m: shape (N, 2), the oldest first, the newest last.
        radius_m: places on the rim are within it.
        most: 1 or more, so that the newest always stays.

    Returns:
        Rows of ``positions_m``; none if there is room.
    """
    if len(positions_m) <= most:
        return np.empty(0, np.int64)
    offsets = positions_m - positions_m[-1]
    near = np.flatnonzero(np.hypot(offsets[:, 0], offsets[:, 1]) <= radius_m)
    return near[:-most]
