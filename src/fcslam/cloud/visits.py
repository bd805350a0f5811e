"""Where a robot was near: of each time it came by the nearest place."""

from collections.abc import Sequence

import numpy as np

from fcslam.records import FloatArray, KeyscanId

Visit = tuple[float, KeyscanId]
"""How far away its nearest place is, in metres, and which one that is."""


def visits_near(places: Sequence[KeyscanId], T_map_place: FloatArray, xy: FloatArray, within_m: float) -> list[Visit]:
    """The visits of a session to the surroundings of a point (2,), in their order.

    ``places``: of one session, in their order, at the poses (N, 3). Consecutive ones that are near are one visit.
    """
    distance = np.hypot(T_map_place[:, 0] - xy[0], T_map_place[:, 1] - xy[1])
    close = np.flatnonzero(distance < within_m)
    stays = np.split(close, np.flatnonzero(np.diff(close) > 1) + 1) if len(close) else []
    nearest = [int(stay[np.argmin(distance[stay])]) for stay in stays]
    return [(float(distance[k]), places[k]) for k in nearest]
