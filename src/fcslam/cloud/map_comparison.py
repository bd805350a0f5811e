"""Comparison of the maps of two sessions: exhaustive around the places that match, or where a joint map lays them."""

from dataclasses import dataclass, replace
from functools import partial
from typing import ClassVar

import numpy as np

from fcslam.cloud.result import Fusion
from fcslam.cloud.session_store import SessionStore
from fcslam.cloud.space import Space
from fcslam.geometry.groups import group_of
from fcslam.graph.cluster import MayDecide, local_frames, relative_frame
from fcslam.graph.consistency import Closures
from fcslam.graph.evidence import AGREES_M, AGREES_RAD, LARGEST_CONTRADICTION, LEAD, MapFit, refutation
from fcslam.graph.trajectory import Trajectory
from fcslam.places.local_maps import SessionMaps, agreement
from fcslam.records import FloatArray, frozen
from fcslam.storage.snapshot import Kept

GROWTH = 1.5
"""The maps of two sessions are compared again when their cluster, or their paths together, have grown by this factor:
at each place, it would take longer than all else. Maps that agreed are compared again when the paths have grown by this
factor twice."""
MOST_TRANSFORMS = 5
"""Comparisons of two sessions that are kept, at different transforms."""

SESSIONS_KEPT = 10
"""Sessions whose local maps are kept, 4 MB each."""
RIVALS = 2
"""Transforms elsewhere at which local maps are compared: those with the best scores."""


@dataclass(frozen=True, slots=True, eq=False)
class _Compared:
    i: int
    """Keyscan of the first session."""
    j: int
    """Keyscan of the second one."""
    T_i_j: FloatArray
    """Pose of keyscan j in keyscan i, shape (3,), by the transform that was compared."""
    keyscans: int
    """Number of keyscans of the map that has fewer."""
    closures: int
    """Number of closures in the cluster."""
    size: int
    """Number of keyscans of both sessions."""
    fit: MapFit
    is_searched: bool
    """Whether no transform elsewhere matters that the fit does not have."""

    @property
    def agrees(self) -> bool:
        return self.fit.is_compared and refutation(self.fit) is None


class MapComparison(Kept):
    """Compares maps that it builds from the keyscans of sessions."""

    KEPT: ClassVar = {"_compared": dict[frozenset[str], list[_Compared]]}

    def __init__(self, sessions: SessionStore, space: Space) -> None:
        self._sessions, self._space = sessions, space
        self._compared: dict[frozenset[str], list[_Compared]] = {}
        """The last comparisons of each pair of sessions, one for each transform: later, places may be forgotten."""
        self._maps: dict[str, SessionMaps] = {}
        """Of the sessions that were compared last; a re-evaluation compares each with several others."""

    def fit(
        self,
        sessions: tuple[str, str],
        a: Trajectory,
        b: Trajectory,
        members: Closures,
        may_decide: MayDecide,
        growth: float = GROWTH,
    ) -> MapFit | None:
        """Compare the maps of two sessions, always in the same order, at the transform of a cluster and elsewhere.

        The closures from a to b, at least one, give the transform. Returns None if a session has no keyscan left around
        the places. An earlier comparison at the same transform counts until the cluster or the paths have grown by a
        factor, if the maps agreed clearly until the paths have, and for good if keyscans were released since. One that
        did not look elsewhere counts only while it may not decide.
        """
        pair, size, T_a_b = frozenset(sessions), len(a) + len(b), relative_frame(a, b, members)
        kept = self._compared.get(pair, [])
        same = [each for each in kept if self._is_at(each, a, b, T_a_b)]
        earlier = same[0] if same and (same[0].is_searched or not may_decide(same[0].fit)) else None
        if earlier is not None:
            is_clear = earlier.agrees and earlier.fit.ratio >= LEAD
            has_grown = size > growth * earlier.size or len(members) > growth * earlier.closures
            if size <= growth * growth * earlier.size if is_clear else not has_grown:
                return earlier.fit
        found = self._compare(sessions, a, b, members, T_a_b, may_decide, earlier)
        if found is not None:
            others = [each for each in kept if each not in same and size < GROWTH * each.size]
            self._compared[pair] = [found, *others[: MOST_TRANSFORMS - 1]]
        return None if found is None else found.fit

    def growth(self, sessions: frozenset[str], size: int) -> float:
        """By which factor the paths of two sessions, ``size`` keyscans together, have grown since their maps agreed."""
        return size / min((each.size for each in self._compared.get(sessions, ()) if each.agrees), default=size)

    def agree_still(self, sessions: tuple[str, str], poses_a: FloatArray, poses_b: FloatArray) -> bool:
        """Whether maps that agreed do so at the poses (N, P) of a joint map, after the paths have grown."""
        fit, pair, size = self.at(sessions, poses_a, poses_b), frozenset(sessions), len(poses_a) + len(poses_b)
        self._compared[pair] = [replace(each, size=size) if each.agrees else each for each in self._compared[pair]]
        return not fit.is_compared or refutation(fit) is None

    @staticmethod
    def _is_at(compared: _Compared, a: Trajectory, b: Trajectory, T_a_b: FloatArray) -> bool:
        from fcslam.lidar.uniqueness import is_elsewhere

        T_i_j = _between(a.poses[compared.i], T_a_b, b.poses[compared.j])
        return not is_elsewhere(T_i_j, compared.T_i_j, np.zeros((1, 2)))

    def _compare(
        self,
        sessions: tuple[str, str],
        a: Trajectory,
        b: Trajectory,
        members: Closures,
        T_a_b: FloatArray,
        may_decide: MayDecide,
        earlier: _Compared | None,
    ) -> _Compared | None:
        # SciPy's transforms take as long to load as a hundred scans, and most missions compare no maps.
        from fcslam.lidar.uniqueness import align_map, alignments, parallel_headings

        maps_a, maps_b = self._maps_of(sessions[0], a.poses), self._maps_of(sessions[1], b.poses)
        group = maps_a.group
        near_a, i, is_complete_a = maps_a.around(a.poses[members.i, : group.axes].mean(axis=0))
        near_b, j, is_complete_b = maps_b.around(b.poses[members.j, : group.axes].mean(axis=0))
        keyscans = min(len(near_a), len(near_b))
        if earlier and not (is_complete_a and is_complete_b) and earlier.keyscans > keyscans:
            return replace(earlier, closures=len(members), size=len(a) + len(b))
        if not keyscans:
            return None
        frames = local_frames(a, b, members)
        T_i_j, fit = _between(a.poses[i], T_a_b, b.poses[j]), _fit(maps_a, maps_b, frames)
        if refutation(fit) is None:
            fit = replace(fit, seen_through=self._space.seen_through(sessions, a.poses, b.poses, frames))
        is_searched = refutation(fit) is not None  # then no transform elsewhere matters
        if not is_searched and may_decide(fit):
            is_searched = True
            (whole_a, T_a_k), (whole_b, T_b_l) = maps_a.whole(near_a), maps_b.whole(near_b)
            best = align_map(whole_a, whole_b, _between(T_a_k, T_a_b, T_b_l))
            fit = replace(fit, seen_m=best.known_m)
            found_elsewhere = alignments(whole_a, whole_b, best.T_a_b, parallel_headings(whole_a, whole_b))
            for rival in (each for each in found_elsewhere[:RIVALS] if each.score_m > 0.0):
                T = group.compose(group.compose(T_a_k, group.from_plane(rival.T_a_b)), group.inverse(T_b_l))
                # Two places that look alike may both fit badly; the better one is more likely.
                found = _fit(maps_a, maps_b, np.broadcast_to(T, b.poses.shape))
                if found.support > fit.rival_support and found.contradiction <= LARGEST_CONTRADICTION:
                    fit = replace(fit, rival_support=found.support)
        return _Compared(i, j, frozen(T_i_j), keyscans, len(members), len(a) + len(b), fit, is_searched)

    def at(self, sessions: tuple[str, str], poses_a: FloatArray, poses_b: FloatArray) -> MapFit:
        """Compare the walls of two sessions at poses (N, P) of their keyscans in the frame of one map."""
        identity = np.broadcast_to(group_of(poses_b).identity, poses_b.shape)
        return _fit(self._maps_of(sessions[0], poses_a), self._maps_of(sessions[1], poses_b), identity)

    def of_join(self, sessions: tuple[str, str], fusion: Fusion, fit: MapFit | None) -> MapFit:
        """The fit of two sessions in a joint map with its ``seen_m``, measured around where their paths come nearest.

        The local maps are those at the sessions' own poses, which other comparisons have built. ``fit``: if known.
        """
        from scipy.spatial import cKDTree

        from fcslam.lidar.uniqueness import align_map

        joint_a, joint_b = (fusion.T_map_base[session] for session in sessions)
        maps_a, maps_b = (self._maps_of(session, fusion.T_local_base[session]) for session in sessions)
        group, own_a, own_b = maps_a.group, maps_a.poses, maps_b.poses
        apart_m, found = cKDTree(joint_a[:, : group.axes]).query(joint_b[:, : group.axes])
        i, j = np.asarray(found), int(np.argmin(apart_m))
        frames = group.compose(group.compose(own_a[i], group.between(joint_a[i], joint_b)), group.inverse(own_b))
        fit = _fit(maps_a, maps_b, frames) if fit is None else fit
        near_a, _, _ = maps_a.around(own_a[i[j], : group.axes])
        near_b, _, _ = maps_b.around(own_b[j, : group.axes])
        if not len(near_a) or not len(near_b):
            return fit
        (whole_a, T_a_k), (whole_b, T_b_l) = maps_a.whole(near_a), maps_b.whole(near_b)
        return replace(fit, seen_m=align_map(whole_a, whole_b, _between(T_a_k, frames[j], T_b_l)).known_m)

    def _maps_of(self, session: str, poses: FloatArray) -> SessionMaps:
        """The local maps of a session whose keyscans have these poses (N, P): the kept ones if nothing has changed."""
        numbers, kept = self._sessions.numbers(session), self._maps.pop(session, None)
        if kept is None or not np.array_equal(kept.poses, poses) or not np.array_equal(kept.numbers, numbers):
            kept = SessionMaps(numbers, partial(self._sessions.scan, session), poses)
        if len(self._maps) >= SESSIONS_KEPT:
            del self._maps[next(iter(self._maps))]
        self._maps[session] = kept
        return kept


def _fit(a: SessionMaps, b: SessionMaps, T_a_b: FloatArray) -> MapFit:
    support, expected, compared_m, contradicting_m = agreement(a, b, T_a_b, (AGREES_M, AGREES_RAD))
    return MapFit(support, expected, -np.inf, compared_m, contradicting_m)


def _between(T_a_i: FloatArray, T_a_b: FloatArray, T_b_j: FloatArray) -> FloatArray:
    """Pose of j in i in the plane, shape (3,)."""
    group = group_of(T_a_i)
    return group.to_plane(group.compose(group.between(T_a_i, T_a_b), T_b_j))
