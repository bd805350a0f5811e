"""Exhaustive comparison of the maps of two sessions around the places that match."""

import numpy as np
from numpy.typing import NDArray

from fcslam.cloud.session_store import SessionStore
from fcslam.geometry import se2
from fcslam.graph.cluster import relative_frame
from fcslam.graph.consistency import Closures
from fcslam.graph.evidence import Uniqueness
from fcslam.graph.trajectory import Trajectory
from fcslam.lidar.scan import point_scan
from fcslam.lidar.submap import Submap, build_submap
from fcslam.records import FloatArray

REACH_M = 20.0
"""Keyscans up to this far from the middle of the matching places make a map: over a corridor's door period, to both
sides."""
MOST_KEYSCANS = 300
"""Most keyscans of such a map; of more, evenly spaced ones."""
LEAST_RIVAL_M = 5.0
"""The best transform elsewhere scores at least as much: maps with little surface are never unique."""


class MapComparison:
    """Compares maps that it builds from the keyscans of sessions."""

    def __init__(self, sessions: SessionStore) -> None:
        self._sessions = sessions

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

        map_a = self._map_around(sessions[0], a, members.i)
        map_b = self._map_around(sessions[1], b, members.j)
        if map_a is None or map_b is None:
            return None
        (near_a, T_a_anchor), (near_b, T_b_anchor) = map_a, map_b
        T_a_b = relative_frame(a, b, members)
        T_anchors = se2.compose(se2.between(T_a_anchor, T_a_b), T_b_anchor)
        best = align_map(near_a, near_b, T_anchors)
        rival = best_elsewhere(near_a, near_b, best.T_a_b)
        against_m = max(LEAST_RIVAL_M, rival.score_m) if rival is not None else LEAST_RIVAL_M
        return Uniqueness(max(0.0, best.score_m) / against_m, best.violation)

    def _map_around(
        self, session: str, path: Trajectory, matched: NDArray[np.int64]
    ) -> tuple[Submap, FloatArray] | None:
        """The session's map around the matched keyscans, and the pose (3,) of its anchor in the path's frame."""
        middle = path.poses[matched, :2].mean(axis=0)
        distance_m = np.hypot(*(path.poses[:, :2] - middle).T)
        keyscans = [keyscan for keyscan in self._sessions.keyscans(session) if distance_m[keyscan.id.number] <= REACH_M]
        if not keyscans:
            return None
        if len(keyscans) > MOST_KEYSCANS:
            rows = np.linspace(0, len(keyscans) - 1, MOST_KEYSCANS).astype(np.int64)
            keyscans = [keyscans[row] for row in rows]
        anchor = min((keyscan.id.number for keyscan in keyscans), key=lambda number: distance_m[number])
        lasers, T_anchor = self._sessions.lasers(session), path.poses[anchor]
        scans = [
            (point_scan(k.ranges_m, k.laser_model(lasers)), se2.between(T_anchor, path.poses[k.id.number]))
            for k in keyscans
        ]
        return build_submap(scans), T_anchor
