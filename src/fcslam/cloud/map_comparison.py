"""Comparison of the maps of two sessions: exhaustive around the places that match, or where a joint map lays them."""

import numpy as np

from fcslam.cloud.session_store import SessionStore
from fcslam.geometry import se2
from fcslam.graph.bridges import Overlap
from fcslam.graph.cluster import relative_frame
from fcslam.graph.consistency import Closures
from fcslam.graph.evidence import Uniqueness
from fcslam.graph.trajectory import Trajectory
from fcslam.lidar.scan import point_scan
from fcslam.lidar.submap import Submap, build_submap
from fcslam.lidar.verification import VerificationConfig
from fcslam.records import FloatArray

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


class MapComparison:
    """Compares maps that it builds from the keyscans of sessions."""

    def __init__(self, sessions: SessionStore, verification: VerificationConfig, separation_m: float) -> None:
        self._sessions = sessions
        self._verification = verification
        self._separation_m = separation_m

    def uniqueness(
        self, sessions: tuple[str, str], a: Trajectory, b: Trajectory, members: Closures
    ) -> Uniqueness | None:
        """Compare the transform of a cluster with the best one elsewhere.

        Args:
            sessions: names of a and b.
            a, b: their trajectories, each in its own coordinate frame.
            members: at least one closure from a to b; together they give the transform.

        Returns:
            The comparison; None if a session has no keyscan left around the places.
        """
        # SciPy's transforms take as long to load as a hundred scans, and most missions compare no maps.
        from fcslam.lidar.uniqueness import align_map, best_elsewhere

        map_a = self._map_around(sessions[0], a.poses, a.poses[members.i, :2].mean(axis=0), REACH_M)
        map_b = self._map_around(sessions[1], b.poses, b.poses[members.j, :2].mean(axis=0), REACH_M)
        if map_a is None or map_b is None:
            return None
        (near_a, T_a_anchor), (near_b, T_b_anchor) = map_a, map_b
        T_a_b = relative_frame(a, b, members)
        T_anchors = se2.compose(se2.between(T_a_anchor, T_a_b), T_b_anchor)
        best = align_map(near_a, near_b, T_anchors)
        rival = best_elsewhere(near_a, near_b, best.T_a_b)
        against_m = max(LEAST_RIVAL_M, rival.score_m) if rival is not None else LEAST_RIVAL_M
        return Uniqueness(max(0.0, best.score_m) / against_m, best.violation)

    def overlap(self, sessions: tuple[str, str], poses_a: FloatArray, poses_b: FloatArray) -> Overlap:
        """Compare the maps of two sessions at separate places where their paths are close together.

        The maps agree at a place if they have no more surface in free space than a predicted closure may have. They
        contradict each other if they have more than even a partially supported closure may have.

        Args:
            sessions: names of a and b.
            poses_a, poses_b: their keyscans in the frame of one map, shape (N, 3), metres and radians.
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
            map_a = self._map_around(sessions[0], poses_a, poses_a[row, :2], OVERLAP_REACH_M)
            map_b = self._map_around(sessions[1], poses_b, poses_b[nearest[row], :2], OVERLAP_REACH_M)
            if map_a is None or map_b is None:
                continue
            (near_a, T_map_a), (near_b, T_map_b) = map_a, map_b
            found = align_map(near_a, near_b, se2.between(T_map_a, T_map_b))
            if found.known_m < LEAST_KNOWN_M:
                continue
            agreeing += found.violation <= self._verification.loose.violation
            contradicting += found.violation > self._verification.partial.violation
        return Overlap(agreeing, contradicting)

    def _map_around(
        self, session: str, poses: FloatArray, middle: FloatArray, reach_m: float
    ) -> tuple[Submap, FloatArray] | None:
        """The session's map around a point (2,), and the pose (3,) of its anchor in the frame of the poses (N, 3)."""
        distance_m = np.hypot(*(poses[:, :2] - middle).T)
        keyscans = [keyscan for keyscan in self._sessions.keyscans(session) if distance_m[keyscan.id.number] <= reach_m]
        if not keyscans:
            return None
        if len(keyscans) > MOST_KEYSCANS:
            rows = np.linspace(0, len(keyscans) - 1, MOST_KEYSCANS).astype(np.int64)
            keyscans = [keyscans[row] for row in rows]
        anchor = min((keyscan.id.number for keyscan in keyscans), key=lambda number: distance_m[number])
        lasers, T_anchor = self._sessions.lasers(session), poses[anchor]
        scans = [
            (point_scan(k.ranges_m, k.laser_model(lasers)), se2.between(T_anchor, poses[k.id.number])) for k in keyscans
        ]
        return build_submap(scans), T_anchor
