"""Visits of a robot to the surroundings of a point: the nearest place of each."""

from collections.abc import Sequence

import numpy as np

from fcslam.records import FloatArray, KeyscanId

Visit = tuple[float, KeyscanId]
"""Distance of the nearest place, in metres, and its keyscan."""


def visits_near(places: Sequence[KeyscanId], T_map_place: FloatArray, xy: FloatArray, within_m: float) -> list[Visit]:
    """The visits of a session to the surroundings of a point (2,), in their order.

    ``places``: of one session, in their order, at the poses (N, 3). Consecutive ones that are near are one visit.
    """
    distance = np.hypot(T_map_place[:, 0] - xy[0], T_map_place[:, 1] - xy[1])
    close = np.flatnonzero(distance < within_m)
    stays = np.split(close, np.flatnonzero(np.diff(close) > 1) + 1) if len(close) else []
    nearest = [int(stay[np.argmin(distance[stay])]) for stay in stays]
    return [(float(distance[k]), places[k]) for k in nearest]
