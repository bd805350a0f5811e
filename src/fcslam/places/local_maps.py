"""Local maps of two sessions around places that both saw, and how well they agree."""

from collections.abc import Callable
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from fcslam.geometry import se2
from fcslam.geometry.groups import group_of
from fcslam.lidar.map_agreement import LocalSubmap, Noise, PlaceAgreement, compare, local_map, noise_of, total
from fcslam.lidar.scan import PointScan
from fcslam.lidar.submap import Located, Submap, build_submap
from fcslam.records import FloatArray

REACH_M = 45.0
"""Keyscans up to this far from the middle of the matching places make a map: of both wings of a repetitive building."""
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


class SessionMaps:
    """Local maps of one session, each of which is built once."""

    def __init__(self, numbers: NDArray[np.int64], scan: Callable[[int], PointScan], poses: FloatArray) -> None:
        """``numbers`` (K,) of the keyscans that are left, ascending; ``scan`` gives the points of one of them.

        ``poses`` (N, P) of all keyscans in one frame, metres and radians.
        """
        self.numbers, self.poses, self.group = numbers, poses, group_of(poses)
        self._scan, self._in_plane = scan, self.group.to_plane(poses)
        self._built: dict[int, LocalSubmap | None] = {}
        self._whole: tuple[NDArray[np.int64], Submap, FloatArray] | None = None

    @cached_property
    def places(self) -> NDArray[np.int64]:
        """Keyscans of separate places along the path, shape (M,)."""
        return _separate(self.positions(self.poses), PLACES_APART_M)

    def positions(self, poses: FloatArray) -> FloatArray:
        """Positions (N, A) in which two floors lie as far apart as two places."""
        return poses[:, : self.group.axes] * (1.0, 1.0, LOCAL_RADIUS_M / SAME_FLOOR_M)[: self.group.axes]

    def around(self, middle: FloatArray) -> tuple[NDArray[np.int64], int, bool]:
        """The keyscans that are left around a point (A,), the nearest one, and whether none was released there."""
        distance_m = self._distance_m(middle)
        keyscans = self._keyscans(middle, REACH_M, MOST_KEYSCANS)
        is_complete = len(keyscans) >= min(MOST_KEYSCANS, int(np.count_nonzero(distance_m <= REACH_M)))
        nearest = int(keyscans[np.argmin(distance_m[keyscans])]) if len(keyscans) else -1
        return keyscans, nearest, is_complete

    def whole(self, keyscans: NDArray[np.int64]) -> tuple[Submap, FloatArray]:
        """The map of keyscans ``around`` a point, in the base of the one in their middle, and the pose (P,) of that.

        Around all points of a short path there are the same keyscans, so the last map is kept.
        """
        if self._whole is None or not np.array_equal(keyscans, self._whole[0]):
            positions = self.poses[keyscans, : self.group.axes]
            anchor = int(keyscans[np.argmin(np.linalg.norm(positions - positions.mean(axis=0), axis=1))])
            self._whole = keyscans, build_submap(self._scans(keyscans, anchor), REACH_M), self.poses[anchor]
        return self._whole[1:]

    def at(self, row: int) -> LocalSubmap | None:
        """The local map around a keyscan, in its base; None if too few keyscans are left there."""
        if row not in self._built:
            keyscans = self._keyscans(self.poses[row, : self.group.axes], LOCAL_M, MOST_LOCAL_KEYSCANS)
            scans = self._scans(keyscans, row)
            self._built[row] = local_map(scans, LOCAL_RADIUS_M) if len(scans) >= FEWEST_LOCAL_KEYSCANS else None
        return self._built[row]

    def _scans(self, keyscans: NDArray[np.int64], anchor: int) -> list[Located]:
        poses = se2.between(self._in_plane[anchor], self._in_plane[keyscans])
        return [(self._scan(k), pose) for k, pose in zip(keyscans.tolist(), poses, strict=True)]

    def _distance_m(self, middle: FloatArray) -> FloatArray:
        off = self.poses[:, : self.group.axes] - middle
        is_on_floor = np.all(np.abs(off[:, 2:]) < SAME_FLOOR_M, axis=1)
        return np.where(is_on_floor, np.hypot(off[:, 0], off[:, 1]), np.inf)

    def _keyscans(self, middle: FloatArray, reach_m: float, most: int) -> NDArray[np.int64]:
        return _at_most(self.numbers[self._distance_m(middle)[self.numbers] <= reach_m], most)


def agreement(a: SessionMaps, b: SessionMaps, T_a_b: FloatArray, drift: tuple[float, float]) -> PlaceAgreement:
    """Compare the local maps of two sessions wherever a place of the first one is near a place of the second.

    ``T_a_b`` between their frames at each keyscan of b, shape (N, P), metres and radians; NaN: not known. ``drift``:
    its largest error at one place, metres and radians.
    """
    from scipy.spatial import cKDTree

    from fcslam.lidar.uniqueness import align_map

    places = [row for row in b.places if np.isfinite(T_a_b[row, 0])]
    in_a = b.group.compose(T_a_b[places], b.poses[places])
    places_a = a.positions(a.poses[a.places])
    found_m, found = cKDTree(places_a).query(a.positions(in_a), distance_upper_bound=LOCAL_RADIUS_M)
    nearest = np.append(a.places, -1)[found]
    # Paths that never come near each other may have seen the same walls from two sides.
    reach_m = LOCAL_M if np.any(found_m <= LOCAL_M) else LOCAL_RADIUS_M
    near = _at_most(np.flatnonzero(found_m <= reach_m), MOST_LOCAL_MAPS)
    maps = [(a.at(int(nearest[k])), b.at(int(places[k]))) for k in near]
    noises = [noise_of(filter(None, side)) for side in zip(*maps, strict=True)]
    noise = Noise(*map(max, zip(*noises, strict=True))) if noises else Noise()
    agreements = []
    for k, (map_a, map_b) in zip(near, maps, strict=True):
        if map_a is None or map_b is None:
            continue
        T_i_j = a.group.to_plane(a.group.between(a.poses[nearest[k]], in_a[k]))
        aligned = align_map(map_a.submap, map_b.submap, T_i_j).T_a_b
        off = se2.between(T_i_j, aligned)
        # Farther off, another wall is the nearest one.
        is_near = np.hypot(off[0], off[1]) < drift[0] and abs(off[2]) < drift[1]
        agreements.append(compare(map_a, map_b, aligned if is_near else T_i_j, noise))
    return total(agreements)


def _separate(positions: FloatArray, apart_m: float) -> NDArray[np.int64]:
    chosen: list[int] = []
    for row in range(len(positions)):
        if not chosen or np.linalg.norm(positions[row] - positions[chosen], axis=1).min() >= apart_m:
            chosen.append(row)
    return np.array(chosen, np.int64)


def _at_most(rows: NDArray[np.int64], most: int) -> NDArray[np.int64]:
    return rows if len(rows) <= most else rows[np.linspace(0, len(rows) - 1, most).astype(np.int64)]
