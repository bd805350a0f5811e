"""Comparison of the maps of two sessions: exhaustive around the places that match, or where a joint map lays them."""

from dataclasses import astuple, dataclass

import numpy as np

from fcslam.cloud.session_store import SessionStore
from fcslam.geometry import se2
from fcslam.graph.bridges import Overlap
from fcslam.graph.cluster import relative_frame
from fcslam.graph.consistency import Closures
from fcslam.graph.evidence import Uniqueness
from fcslam.graph.trajectory import Trajectory
from fcslam.lidar.scan import keyscan_points
from fcslam.lidar.submap import Submap, build_submap
from fcslam.lidar.verification import PARTIAL, VerificationConfig
from fcslam.records import FloatArray, KeyscanId, frozen
from fcslam.storage.state_file import State

REACH_M = 20.0
"""Keyscans up to this far from the middle of the matching places make a map: over a corridor's door period, to both
sides."""
MOST_KEYSCANS = 300
"""Most keyscans of such a map; of more, evenly spaced ones."""
LEAST_RIVAL_M = 5.0
"""The best transform elsewhere scores at least as much: maps with little surface are never unique."""

NEAR_M = 3.0
"""Paths of two robots this close together show the same surfaces, unless a wall is between them."""
OVERLAP_REACH_M = 6.0
"""Keyscans up to this far from a place make a map of it."""
MOST_PLACES = 8
"""Most places at which the maps of two sessions are compared; of more, evenly spaced ones."""
LEAST_KNOWN_M = 10.0
"""Surface of one map in known area of the other that a comparison needs."""


@dataclass(frozen=True, slots=True, eq=False)
class _Near:
    """The map of one session around a point."""

    submap: Submap
    """In the frame of its anchor."""
    anchor: KeyscanId
    keyscans: int
    is_complete: bool
    """Whether no keyscan around the point was released."""


@dataclass(frozen=True, slots=True, eq=False)
class _Compared:
    """A comparison of the maps of two sessions."""

    i: KeyscanId
    j: KeyscanId
    T_i_j: FloatArray
    """Pose of keyscan j in keyscan i, shape (3,), by the transform that was compared."""
    keyscans: int
    """Number of keyscans of the map that has fewer."""
    uniqueness: Uniqueness

    def reversed(self) -> "_Compared":
        return _Compared(self.j, self.i, frozen(se2.inverse(self.T_i_j)), self.keyscans, self.uniqueness)


class MapComparison:
    """Compares maps that it builds from the keyscans of sessions."""

    def __init__(self, sessions: SessionStore, verification: VerificationConfig, separation_m: float) -> None:
        self._sessions = sessions
        self._verification = verification
        self._separation_m = separation_m
        self._compared: dict[frozenset[str], _Compared] = {}
        """The comparison of each pair of sessions that had most keyscans: later, places may be forgotten."""

    def uniqueness(
        self, sessions: tuple[str, str], a: Trajectory, b: Trajectory, members: Closures
    ) -> Uniqueness | None:
        """Compare the transform of a cluster with the best one elsewhere.

        Args:
            sessions: names of a and b.
            a, b: their trajectories, each in its own coordinate frame.
            members: at least one closure from a to b; together they give the transform.

        Returns:
            The comparison; None if a session has no keyscan left around the places. If keyscans were released since an
            earlier comparison at the same transform, that one.
        """
        earlier = self._compared.get(frozenset(sessions))
        found = self._compare(sessions, a, b, members, earlier)
        if found is not None:
            self._compared[frozenset(sessions)] = found
        return None if found is None else found.uniqueness

    def _compare(
        self,
        sessions: tuple[str, str],
        a: Trajectory,
        b: Trajectory,
        members: Closures,
        earlier: _Compared | None,
    ) -> _Compared | None:
        # SciPy's transforms take as long to load as a hundred scans, and most missions compare no maps.
        from fcslam.lidar.uniqueness import align_map, best_elsewhere, is_elsewhere

        near_a = self._map_around(sessions[0], a.poses, a.poses[members.i, :2].mean(axis=0), REACH_M)
        near_b = self._map_around(sessions[1], b.poses, b.poses[members.j, :2].mean(axis=0), REACH_M)
        T_a_b = relative_frame(a, b, members)
        if earlier is not None and not (near_a and near_b and near_a.is_complete and near_b.is_complete):
            before = earlier if earlier.i.robot == sessions[0] else earlier.reversed()
            T_i_j = _between(a.poses[before.i.number], T_a_b, b.poses[before.j.number])
            has_more = not (near_a and near_b) or before.keyscans > min(near_a.keyscans, near_b.keyscans)
            if has_more and not is_elsewhere(T_i_j, before.T_i_j, np.zeros((1, 2))):
                return before
        if near_a is None or near_b is None:
            return None
        i, j = near_a.anchor, near_b.anchor
        T_i_j = _between(a.poses[i.number], T_a_b, b.poses[j.number])
        best = align_map(near_a.submap, near_b.submap, T_i_j)
        rival = best_elsewhere(near_a.submap, near_b.submap, best.T_a_b)
        against_m = max(LEAST_RIVAL_M, rival.score_m) if rival is not None else LEAST_RIVAL_M
        uniqueness = Uniqueness(max(0.0, best.score_m) / against_m, best.violation)
        return _Compared(i, j, frozen(T_i_j), min(near_a.keyscans, near_b.keyscans), uniqueness)

    def overlap(self, sessions: tuple[str, str], poses_a: FloatArray, poses_b: FloatArray) -> Overlap:
        """Compare the maps of two sessions at separate places where their paths are close together.

        The maps agree at a place if they have no more surface in free space than a predicted closure may have. They
        contradict each other if they have more than even a partially supported closure may have. Poses (N, 3) of their
        keyscans in the frame of one map, in metres and radians.
        """
        from scipy.spatial import cKDTree

        from fcslam.lidar.uniqueness import align_map

        found_m, found_rows = cKDTree(poses_b[:, :2]).query(poses_a[:, :2], distance_upper_bound=NEAR_M)
        distance_m, nearest = np.asarray(found_m), np.asarray(found_rows)
        rows = np.flatnonzero(np.isfinite(distance_m))
        chosen: list[int] = []
        for row in rows.tolist():
            if all(np.hypot(*(poses_a[row, :2] - poses_a[k, :2])) >= self._separation_m for k in chosen):
                chosen.append(row)
        if len(chosen) > MOST_PLACES:
            chosen = [chosen[k] for k in np.linspace(0, len(chosen) - 1, MOST_PLACES).astype(np.int64)]
        agreeing = contradicting = 0
        for row in chosen:
            near_a = self._map_around(sessions[0], poses_a, poses_a[row, :2], OVERLAP_REACH_M)
            near_b = self._map_around(sessions[1], poses_b, poses_b[nearest[row], :2], OVERLAP_REACH_M)
            if near_a is None or near_b is None:
                continue
            T_i_j = se2.between(poses_a[near_a.anchor.number], poses_b[near_b.anchor.number])
            found = align_map(near_a.submap, near_b.submap, T_i_j)
            if found.known_m < LEAST_KNOWN_M:
                continue
            agreeing += found.violation <= self._verification.loose.violation
            contradicting += found.violation > PARTIAL.violation
        return Overlap(agreeing, contradicting)

    def state(self) -> State:
        """The state that ``restore`` needs."""
        rows = [(c.i, c.j, c.T_i_j.tolist(), c.keyscans, astuple(c.uniqueness)) for c in self._compared.values()]
        return {"compared": rows}

    def restore(self, state: State) -> None:
        """Take over a ``state``."""
        for i, j, T_i_j, keyscans, uniqueness in state["compared"]:
            compared = _Compared(KeyscanId(*i), KeyscanId(*j), frozen(T_i_j), keyscans, Uniqueness(*uniqueness))
            self._compared[frozenset((compared.i.robot, compared.j.robot))] = compared

    def _map_around(self, session: str, poses: FloatArray, middle: FloatArray, reach_m: float) -> _Near | None:
        """The session's map around a point (2,) in the frame of the poses (N, 3)."""
        distance_m = np.hypot(*(poses[:, :2] - middle).T)
        keyscans = [keyscan for keyscan in self._sessions.keyscans(session) if distance_m[keyscan.id.number] <= reach_m]
        if not keyscans:
            return None
        is_complete = len(keyscans) == np.count_nonzero(distance_m <= reach_m)
        if len(keyscans) > MOST_KEYSCANS:
            rows = np.linspace(0, len(keyscans) - 1, MOST_KEYSCANS).astype(np.int64)
            keyscans = [keyscans[row] for row in rows]
        anchor = min((keyscan.id for keyscan in keyscans), key=lambda id_: distance_m[id_.number])
        lasers, T_anchor = self._sessions.lasers(session), poses[anchor.number]
        scans = [(keyscan_points(k, lasers), se2.between(T_anchor, poses[k.id.number])) for k in keyscans]
        return _Near(build_submap(scans), anchor, len(keyscans), is_complete)


def _between(T_a_i: FloatArray, T_a_b: FloatArray, T_b_j: FloatArray) -> FloatArray:
    """T_i_j (3,) of two poses, each in the frame of its trajectory."""
    return se2.compose(se2.between(T_a_i, T_a_b), T_b_j)
