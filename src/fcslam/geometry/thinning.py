"""Which places the cloud may forget where a robot has stored very many (density limit per area)."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fcslam.records import FloatArray


def surplus_places(positions_m: FloatArray, side_m: float, most: int) -> NDArray[np.int64]:
    """Find the oldest places in the newest place's grid square beyond the ``most`` that it may hold.

    Called after every new place, it bounds memory by the area that a robot drives in, and no area loses its last place.
    Discs around the newest place would not do this: a moving robot would delete the places behind it.

    Args:
        positions_m: shape (N, 2) in ``map``, metres, or (N, 3) in space, where squares are cubes; the oldest place
            first, the newest last.
        side_m: side of the squares, metres. The origin of ``map`` is the centre of a square.
        most: places that a square may hold, 1 or more.

    Returns:
        Rows of ``positions_m`` to forget, shape (K,), ascending; empty if the square is not full.
    """
    if len(positions_m) <= most:
        return np.empty(0, np.int64)
    return _in_newest_square(positions_m, side_m)[:-most]


def places_of_old_sessions(positions_m: FloatArray, sessions: ArrayLike, side_m: float, most: int) -> NDArray[np.int64]:
    """Find the places in the newest place's grid square that are not of the ``most`` newest sessions there.

    A robot that comes back every day thus keeps a few visits of each square. ``sessions``: the session of each place,
    by name or number, shape (N,); otherwise as ``surplus_places``.
    """
    rows = _in_newest_square(positions_m, side_m)
    owners = np.asarray(sessions)[rows]
    newest = list(dict.fromkeys(owners[::-1].tolist()))[:most]
    return rows[~np.isin(owners, newest)]


def _in_newest_square(positions_m: FloatArray, side_m: float) -> NDArray[np.int64]:
    """Rows in the square of the newest place, ascending."""
    squares = np.floor(positions_m / side_m + 0.5)
    return np.flatnonzero((squares == squares[-1]).all(axis=1))
