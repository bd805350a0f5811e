"""Which place may be forgotten where a robot has stored very many."""

import numpy as np

from fcslam.records import FloatArray


def crowded_out(positions_m: FloatArray, radius_m: float, most: int) -> int | None:
    """The oldest place within ``radius_m`` of the newest one if they are more than ``most`` together, itself included.

    Asked after every new place, no disc of half the radius ever holds more than ``most``: as long as places stay where
    they are, memory is bounded by the area that a robot drives in and not by how long it drives.

    Args:
        positions_m: shape (N, 2), the oldest first, the newest last.
        radius_m: places on the rim are within it.
        most: 1 or more, so that the newest always stays.

    Returns:
        A row of ``positions_m``, None if there is room.
    """
    if len(positions_m) <= most:
        return None
    offsets = positions_m - positions_m[-1]
    near = np.flatnonzero(np.hypot(offsets[:, 0], offsets[:, 1]) <= radius_m)
    return int(near[0]) if len(near) > most else None
