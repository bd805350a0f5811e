"""The pictures of a run's maps, and the files that say how good they are where."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from fcslam.maps.drawing import map_png
from fcslam.maps.occupancy_map import OccupancyMap
from fcslam.records import ClosureStatus, FloatArray, LoopClosure
from fcslam.runs import QUALITY


def picture(
    occupancy: OccupancyMap,
    trajectories: Mapping[str, FloatArray],
    closures: Sequence[LoopClosure],
    keyscans: Mapping[str, FloatArray],
) -> bytes:
    """The map with trajectories (N, 3) by session, and a line for each accepted closure between robots.

    ``keyscans`` are poses (K, 3) by session; closures with an end outside of the map are left out.
    """
    lines = [
        np.array((keyscans[i.robot][i.number, :2], keyscans[j.robot][j.number, :2]))
        for i, j in ((closure.i, closure.j) for closure in closures if closure.status is ClosureStatus.ACCEPTED)
        if i.robot != j.robot and i.robot in keyscans and j.robot in keyscans
    ]
    return map_png(occupancy, trajectories, lines)


def quality_files(certificates: Mapping[int, Mapping[str, Any]], maps: Mapping[int, OccupancyMap]) -> dict[str, bytes]:
    """``quality.json``, and a picture of each map that has a certificate; nothing if none has."""
    if not certificates:
        return {}
    from fcslam.maps.certificate import certificate_json, certificate_png

    pictures = {
        f"{QUALITY}_{k}.png" if k else f"{QUALITY}.png": certificate_png(one, maps[k])
        for k, one in certificates.items()
    }
    return {f"{QUALITY}.json": certificate_json(certificates), **pictures}
