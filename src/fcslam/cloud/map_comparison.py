"""Comparison of the maps of two sessions: exhaustive around the places that match, or where a joint map lays them."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from fcslam.cloud.joint_graph import SURPRISE_M, SURPRISE_RAD
from fcslam.cloud.session_store import SessionStore
from fcslam.geometry import se2
from fcslam.graph.cluster import relative_frame
from fcslam.graph.consistency import Closures
from fcslam.graph.evidence import MapFit, refutation
from fcslam.graph.trajectory import Trajectory
from fcslam.lidar.map_agreement import LocalSubmap, Noise, PlaceAgreement, compare, local_map, noise_of, total
from fcslam.lidar.scan import PointScan, keyscan_points
from fcslam.lidar.submap import build_submap
from fcslam.records import FloatArray, Keyscan, KeyscanId, frozen
from fcslam.storage.snapshot import Kept

REACH_M = 45.0
"""Keyscans up to this far from the middle of the matching places make a map: of both wings of a building that repeats
itself."""
MOST_KEYSCANS = 150
"""Most keyscans of such a map; of more, evenly spaced ones."""

GROWTH = 1.5
"""The maps of two sessions are compared again when their cluster, or their paths together, have grown by this factor:
at each place, it would take longer than all else. Maps that agreed are compared again when the paths have grown by this
factor twice."""
MOST_TRANSFORMS = 5
"""Comparisons of two sessions that are kept, at different transforms."""

LOCAL_M = 8.0
"""Keyscans up to this far from a place make its local map."""
LOCAL_RADIUS_M = 14.0
"""Radius of a local map."""
FEWEST_LOCAL_KEYSCANS, MOST_LOCAL_KEYSCANS = 4, 30
PLACES_APART_M = 0.5 * LOCAL_M
"""Distance of local maps, which overlap by half."""
MOST_LOCAL_MAPS = 16
"""Most places at which local maps are compared; of more, evenly spaced ones."""
FARTHEST_M = 20.0
"""A closure gives the transform between two maps up to this far along the path: beyond, drift counts."""
RIVALS = 2
"""Transforms elsewhere at which local maps are compared: those with the best scores."""
_NONE = KeyscanId("", -1)


@dataclass(frozen=True, slots=True, eq=False)
class _Compared:
    i: KeyscanId
    j: KeyscanId
    T_i_j: FloatArray
    """Pose of keyscan j in keyscan i, shape (3,), by the transform that was compared."""
    keyscans: int
    """Number of keyscans of the map that has fewer."""
    closures: int
    """Number of closures in the cluster."""
    size: int
    """Number of keyscans of both sessions."""
    fit: MapFit

    @property
    def agrees(self) -> bool:
        return self.fit.is_compared and refutation(self.fit) is None

    def reversed(self) -> "_Compared":
        return replace(self, i=self.j, j=self.i, T_i_j=frozen(se2.inverse(self.T_i_j)))


class MapComparison(Kept):
    """Compares maps that it builds from the keyscans of sessions."""

    KEPT: ClassVar = {"_compared": dict[frozenset[str], list[_Compared]]}

    def __init__(self, sessions: SessionStore) -> None:
        self._sessions = sessions
        self._compared: dict[frozenset[str], list[_Compared]] = {}
        """The last comparisons of each pair of sessions, one for each transform: later, places may be forgotten."""

    def fit(
        self, sessions: tuple[str, str], a: Trajectory, b: Trajectory, members: Closures, growth: float = GROWTH
    ) -> MapFit | None:
        """Compare two maps at the transform of a cluster, and at the best transforms elsewhere.

        The closures from a to b, at least one, give the transform. Returns None if a session has no keyscan left around
        the places. An earlier comparison at the same transform counts until the cluster or the paths have grown by a
        factor, if the maps agreed until the paths have, and for good if keyscans were released since.
        """
        pair = frozenset(sessions)
        T_a_b, size = relative_frame(a, b, members), len(a) + len(b)
        earlier = [each for each in self._compared.get(pair, ()) if self._is_at(each, sessions, a, b, T_a_b)]
        if earlier and earlier[0].agrees and size < growth * growth * earlier[0].size:
            return earlier[0].fit
        if earlier and len(members) < growth * earlier[0].closures and size < growth * earlier[0].size:
            return earlier[0].fit
        found = self._compare(sessions, a, b, members, T_a_b, earlier)
        if found is not None:
            others = [c for c in self._compared.get(pair, ()) if c not in earlier and size < GROWTH * c.size]
            self._compared[pair] = [found, *others[: MOST_TRANSFORMS - 1]]
        return None if found is None else found.fit

    def growth(self, sessions: frozenset[str], size: int) -> float:
        """By which factor the paths of two sessions, ``size`` keyscans together, have grown since their maps agreed."""
        return size / min((each.size for each in self._compared.get(sessions, ()) if each.agrees), default=size)

    def agree_still(self, sessions: tuple[str, str], poses_a: FloatArray, poses_b: FloatArray) -> bool:
        """Whether maps that agreed do so at the poses (N, 3) of a joint map, after the paths have grown."""
        fit, pair, size = self.at(sessions, poses_a, poses_b), frozenset(sessions), len(poses_a) + len(poses_b)
        self._compared[pair] = [replace(each, size=size) if each.agrees else each for each in self._compared[pair]]
        return not fit.is_compared or refutation(fit) is None

    @staticmethod
    def _is_at(
        compared: "_Compared", sessions: tuple[str, str], a: Trajectory, b: Trajectory, T_a_b: FloatArray
    ) -> bool:
        from fcslam.lidar.uniqueness import is_elsewhere

        before = compared if compared.i.robot == sessions[0] else compared.reversed()
        T_i_j = _between(a.poses[before.i.number], T_a_b, b.poses[before.j.number])
        return not is_elsewhere(T_i_j, before.T_i_j, np.zeros((1, 2)))

    def _compare(
        self,
        sessions: tuple[str, str],
        a: Trajectory,
        b: Trajectory,
        members: Closures,
        T_a_b: FloatArray,
        earlier: "list[_Compared]",
    ) -> "_Compared | None":
        # SciPy's transforms take as long to load as a hundred scans, and most missions compare no maps.
        from fcslam.lidar.uniqueness import align_map, alignments, parallel_headings

        local_maps = _LocalMaps(self._sessions, sessions, (a.poses, b.poses))
        near_a, i, is_complete_a = local_maps.around(0, a.poses[members.i, :2].mean(axis=0))
        near_b, j, is_complete_b = local_maps.around(1, b.poses[members.j, :2].mean(axis=0))
        keyscans = min(len(near_a), len(near_b))
        if earlier and not (is_complete_a and is_complete_b) and earlier[0].keyscans > keyscans:
            return replace(earlier[0], closures=len(members), size=len(a) + len(b))
        if not keyscans:
            return None
        T_a_i, T_b_j = a.poses[i.number], b.poses[j.number]
        T_i_j = _between(T_a_i, T_a_b, T_b_j)
        fit = _fit(local_maps.agreement(_transforms(a, b, members)))
        if refutation(fit) is None:  # else no transform elsewhere matters
            whole_a = build_submap(local_maps.scans(0, near_a, i.number), REACH_M)
            whole_b = build_submap(local_maps.scans(1, near_b, j.number), REACH_M)
            best = align_map(whole_a, whole_b, T_i_j)
            fit = replace(fit, seen_m=best.known_m)
            found_elsewhere = alignments(whole_a, whole_b, best.T_a_b, parallel_headings(whole_a, whole_b))
            for rival in (each for each in found_elsewhere[:RIVALS] if each.score_m > 0.0):
                T = se2.compose(se2.compose(T_a_i, rival.T_a_b), se2.inverse(T_b_j))
                found = local_maps.agreement(np.broadcast_to(T, b.poses.shape))
                if found.support > fit.rival_support and refutation(_fit(found)) is None:
                    fit = replace(fit, rival_support=found.support)
        return _Compared(i, j, frozen(T_i_j), keyscans, len(members), len(a) + len(b), fit)

    def at(self, sessions: tuple[str, str], poses_a: FloatArray, poses_b: FloatArray) -> MapFit:
        """Compare the maps of two sessions at poses (N, 3) of their keyscans in the frame of one map."""
        return _fit(_LocalMaps(self._sessions, sessions, (poses_a, poses_b)).agreement(np.zeros_like(poses_b)))


def _fit(agreement: PlaceAgreement) -> MapFit:
    support, expected, compared_m, contradicting_m = agreement
    return MapFit(support, expected, -np.inf, compared_m, contradicting_m)


class _LocalMaps:
    """Local maps of two sessions around separate places of the second one's path, which are built once."""

    def __init__(self, store: SessionStore, sessions: tuple[str, str], poses: tuple[FloatArray, FloatArray]) -> None:
        """``poses`` (N, 3) of both sessions' keyscans, each in its own frame, metres and radians."""
        self._store, self._sessions, self._poses = store, sessions, poses
        self._built: dict[tuple[int, int], LocalSubmap | None] = {}

    @cached_property
    def _places(self) -> NDArray[np.int64]:
        return _separate(self._poses[1], np.arange(len(self._poses[1])), PLACES_APART_M)

    def around(self, side: int, middle: FloatArray) -> tuple[list[Keyscan], KeyscanId, bool]:
        """The keyscans of a session that are left around a point (2,), the nearest one, and whether none was released
        there."""
        distance_m = self._distance_m(side, middle)
        keyscans = self._keyscans(side, middle, REACH_M, MOST_KEYSCANS)
        is_complete = len(keyscans) >= min(MOST_KEYSCANS, int(np.count_nonzero(distance_m <= REACH_M)))
        nearest = min((k.id for k in keyscans), key=lambda id_: float(distance_m[id_.number]), default=_NONE)
        return keyscans, nearest, is_complete

    def scans(self, side: int, keyscans: Sequence[Keyscan], anchor: int) -> list[tuple[PointScan, FloatArray]]:
        lasers, poses = self._store.lasers(self._sessions[side]), self._poses[side]
        return [(keyscan_points(k, lasers), se2.between(poses[anchor], poses[k.id.number])) for k in keyscans]

    def _distance_m(self, side: int, middle: FloatArray) -> FloatArray:
        distance_m: FloatArray = np.hypot(*(self._poses[side][:, :2] - middle).T)
        return distance_m

    def _keyscans(self, side: int, middle: FloatArray, reach_m: float, most: int) -> list[Keyscan]:
        distance_m = self._distance_m(side, middle)
        near = [k for k in self._store.keyscans(self._sessions[side]) if distance_m[k.id.number] <= reach_m]
        return [near[row] for row in _at_most(np.arange(len(near)), most)]

    def agreement(self, T_a_b: FloatArray) -> PlaceAgreement:
        """Compare the local maps of both sessions wherever the first one was near a place of the second.

        ``T_a_b`` between their frames at each keyscan of b, shape (N, 3), metres and radians; NaN: not known.
        """
        from scipy.spatial import cKDTree

        from fcslam.lidar.uniqueness import align_map

        poses_a, poses_b = self._poses
        places = [row for row in self._places if np.isfinite(T_a_b[row, 0])]
        in_a = se2.compose(T_a_b[places], poses_b[places])
        found_m, found_rows = cKDTree(poses_a[:, :2]).query(in_a[:, :2], distance_upper_bound=LOCAL_M)
        nearest = np.asarray(found_rows)
        near = _at_most(np.flatnonzero(np.isfinite(found_m)), MOST_LOCAL_MAPS)
        rows = [(int(nearest[k]), int(places[k])) for k in near]
        maps = [(self._at(0, i), self._at(1, j)) for i, j in rows]
        noises = [noise_of(filter(None, side)) for side in zip(*maps, strict=True)]
        noise = Noise(*map(max, zip(*noises, strict=True))) if noises else Noise()
        agreements = []
        for (i, j), (map_a, map_b) in zip(rows, maps, strict=True):
            if map_a is None or map_b is None:
                continue
            T_i_j = _between(poses_a[i], T_a_b[j], poses_b[j])
            aligned = align_map(map_a.submap, map_b.submap, T_i_j).T_a_b
            off = se2.between(T_i_j, aligned)
            # Farther off, another wall is the nearest one.
            is_near = np.hypot(off[0], off[1]) < SURPRISE_M and abs(off[2]) < SURPRISE_RAD
            agreements.append(compare(map_a, map_b, aligned if is_near else T_i_j, noise))
        return total(agreements)

    def _at(self, side: int, row: int) -> LocalSubmap | None:
        if (side, row) not in self._built:
            keyscans = self._keyscans(side, self._poses[side][row, :2], LOCAL_M, MOST_LOCAL_KEYSCANS)
            scans = self.scans(side, keyscans, row)
            is_enough = len(scans) >= FEWEST_LOCAL_KEYSCANS
            self._built[side, row] = local_map(scans, LOCAL_RADIUS_M) if is_enough else None
        return self._built[side, row]


def _separate(poses: FloatArray, rows: NDArray[np.int64], apart_m: float) -> NDArray[np.int64]:
    chosen: list[int] = []
    for row in rows.tolist():
        if not chosen or np.hypot(*(poses[row, :2] - poses[chosen, :2]).T).min() >= apart_m:
            chosen.append(row)
    return np.array(chosen, np.int64)


def _at_most(rows: NDArray[np.int64], most: int) -> NDArray[np.int64]:
    return rows if len(rows) <= most else rows[np.linspace(0, len(rows) - 1, most).astype(np.int64)]


def _transforms(a: Trajectory, b: Trajectory, members: Closures) -> FloatArray:
    """T_a_b (N, 3) at each of the N keyscans of b by the closure that is nearest along b's path, without drift.

    NaN farther than ``FARTHEST_M`` of path from any closure. Tags fix the heading worse than walls, so they count only
    without other closures, and then all together.
    """
    walls = np.flatnonzero(members.tags == 0) if len(members.tags) else np.arange(len(members))
    if not len(walls):
        return np.broadcast_to(relative_frame(a, b, members), b.poses.shape)
    members = members.select(walls)
    distance_m = np.abs(b.travel_m[:, None] - b.travel_m[members.j][None])
    nearest = np.argmin(distance_m, axis=1)
    T_a_b = se2.compose(se2.compose(a.poses[members.i], members.T_i_j), se2.inverse(b.poses[members.j]))
    T: FloatArray = T_a_b[nearest]
    T[distance_m.min(axis=1) > FARTHEST_M] = np.nan
    return T


def _between(T_a_i: FloatArray, T_a_b: FloatArray, T_b_j: FloatArray) -> FloatArray:
    return se2.compose(se2.between(T_a_i, T_a_b), T_b_j)
