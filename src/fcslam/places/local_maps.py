"""Local maps of two sessions around places that both saw, and how well they agree."""

from collections.abc import Callable
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fcslam.geometry import se2
from fcslam.geometry.groups import group_of
from fcslam.lidar.map_agreement import LocalSubmap, Noise, PlaceAgreement, compare, local_map, noise_of, total
from fcslam.lidar.scan import PointScan
from fcslam.lidar.submap import Submap, build_submap
from fcslam.records import FloatArray

REACH_M = 45.0
"""Keyscans up to this far from the middle of the matching places make a map: of both wings of a building that repeats
itself."""
MOST_KEYSCANS = 150
"""Most keyscans of such a map; of more, evenly spaced ones."""

LOCAL_M = 8.0
"""Keyscans up to this far from a place make its local map."""
LOCAL_RADIUS_M = 14.0
"""Radius of a local map."""
FEWEST_LOCAL_KEYSCANS, MOST_LOCAL_KEYSCANS = 4, 30
PLACES_APART_M = 0.5 * LOCAL_M
"""Distance of local maps, which overlap by half."""
SAME_FLOOR_M = 1.5
"""Keyscans that differ more in height are on two floors, which share no map."""
MOST_LOCAL_MAPS = 16
"""Most places at which local maps are compared; of more, evenly spaced ones."""


class SeenKeyscans(NamedTuple):
    """The keyscans of a session that are left."""

    numbers: NDArray[np.int64]
    """Shape (K,), ascending."""
    scan: Callable[[int], PointScan]
    """The points of one of them."""


class LocalMaps:
    """Local maps of two sessions around separate places of the second one's path, which are built once."""

    def __init__(
        self,
        seen: tuple[SeenKeyscans, SeenKeyscans],
        poses: tuple[FloatArray, FloatArray],
        drift: tuple[float, float],
    ) -> None:
        """``poses`` (N, P) of all keyscans of both sessions, each in its own frame, metres and radians.

        ``drift``: largest error of a transform between both at one place, metres and radians.
        """
        self._seen, self._drift, self._group = seen, drift, group_of(poses[0])
        self._poses, self._in_plane = poses, [self._group.to_plane(side) for side in poses]
        self._built: dict[tuple[int, int], LocalSubmap | None] = {}

    @cached_property
    def _places(self) -> NDArray[np.int64]:
        return _separate(self._positions(self._poses[1]), PLACES_APART_M)

    def _positions(self, poses: FloatArray) -> FloatArray:
        """Positions (N, A) in which two floors lie as far apart as two places."""
        return poses[:, : self._group.axes] * (1.0, 1.0, LOCAL_RADIUS_M / SAME_FLOOR_M)[: self._group.axes]

    def around(self, side: int, middle: FloatArray) -> tuple[NDArray[np.int64], int, bool]:
        """The keyscans of a session that are left around a point (A,), the nearest one, and whether none was released
        there."""
        distance_m = self._distance_m(side, middle)
        keyscans = self._keyscans(side, middle, REACH_M, MOST_KEYSCANS)
        is_complete = len(keyscans) >= min(MOST_KEYSCANS, int(np.count_nonzero(distance_m <= REACH_M)))
        nearest = int(keyscans[np.argmin(distance_m[keyscans])]) if len(keyscans) else -1
        return keyscans, nearest, is_complete

    def whole(self, side: int, keyscans: NDArray[np.int64], anchor: int) -> Submap:
        """The map of keyscans ``around`` a point, in the base of one of them."""
        return build_submap(self._scans(side, keyscans, anchor), REACH_M)

    def _scans(self, side: int, keyscans: NDArray[np.int64], anchor: int) -> list[tuple[PointScan, FloatArray]]:
        poses = se2.between(self._in_plane[side][anchor], self._in_plane[side][keyscans])
        return [(self._seen[side].scan(k), pose) for k, pose in zip(keyscans.tolist(), poses, strict=True)]

    def _distance_m(self, side: int, middle: FloatArray) -> FloatArray:
        off = self._poses[side][:, : self._group.axes] - middle
        is_on_floor = np.all(np.abs(off[:, 2:]) < SAME_FLOOR_M, axis=1)
        return np.where(is_on_floor, np.hypot(off[:, 0], off[:, 1]), np.inf)

    def _keyscans(self, side: int, middle: FloatArray, reach_m: float, most: int) -> NDArray[np.int64]:
        numbers = self._seen[side].numbers
        return _at_most(numbers[self._distance_m(side, middle)[numbers] <= reach_m], most)

    def agreement(self, T_a_b: FloatArray) -> PlaceAgreement:
        """Compare the local maps of both sessions wherever the first one was near a place of the second.

        ``T_a_b`` between their frames at each keyscan of b, shape (N, P), metres and radians; NaN: not known.
        """
        from scipy.spatial import cKDTree

        from fcslam.lidar.uniqueness import align_map

        poses_a, poses_b = self._poses
        places = [row for row in self._places if np.isfinite(T_a_b[row, 0])]
        in_a = self._group.compose(T_a_b[places], poses_b[places])
        tree = cKDTree(self._positions(poses_a))
        found_m, found_rows = tree.query(self._positions(in_a), distance_upper_bound=LOCAL_RADIUS_M)
        nearest = np.asarray(found_rows)
        # Paths that never come near each other may have seen the same walls from two sides.
        reach_m = LOCAL_M if np.any(found_m <= LOCAL_M) else LOCAL_RADIUS_M
        near = _at_most(np.flatnonzero(found_m <= reach_m), MOST_LOCAL_MAPS)
        maps = [(self._at(0, int(nearest[k])), self._at(1, int(places[k]))) for k in near]
        noises = [noise_of(filter(None, side)) for side in zip(*maps, strict=True)]
        noise = Noise(*map(max, zip(*noises, strict=True))) if noises else Noise()
        agreements = []
        for k, (map_a, map_b) in zip(near, maps, strict=True):
            if map_a is None or map_b is None:
                continue
            T_i_j = self._group.to_plane(self._group.between(poses_a[nearest[k]], in_a[k]))
            aligned = align_map(map_a.submap, map_b.submap, T_i_j).T_a_b
            off = se2.between(T_i_j, aligned)
            # Farther off, another wall is the nearest one.
            is_near = np.hypot(off[0], off[1]) < self._drift[0] and abs(off[2]) < self._drift[1]
            agreements.append(compare(map_a, map_b, aligned if is_near else T_i_j, noise))
        return total(agreements)

    def _at(self, side: int, row: int) -> LocalSubmap | None:
        if (side, row) not in self._built:
            middle = self._poses[side][row, : self._group.axes]
            keyscans = self._keyscans(side, middle, LOCAL_M, MOST_LOCAL_KEYSCANS)
            scans = self._scans(side, keyscans, row)
            is_enough = len(scans) >= FEWEST_LOCAL_KEYSCANS
            self._built[side, row] = local_map(scans, LOCAL_RADIUS_M) if is_enough else None
        return self._built[side, row]


def _separate(positions: FloatArray, apart_m: float) -> NDArray[np.int64]:
    chosen: list[int] = []
    for row in range(len(positions)):
        if not chosen or np.linalg.norm(positions[row] - positions[chosen], axis=1).min() >= apart_m:
            chosen.append(row)
    return np.array(chosen, np.int64)


def _at_most(rows: NDArray[np.int64], most: int) -> NDArray[np.int64]:
    return rows if len(rows) <= most else rows[np.linspace(0, len(rows) - 1, most).astype(np.int64)]
