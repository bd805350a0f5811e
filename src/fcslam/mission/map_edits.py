"""Edits that are drawn in a finished map: they are tied to the mission's keyscans, so that they move with the map."""

from collections.abc import Iterator, Sequence

import numpy as np

from fcslam.errors import InputError
from fcslam.geometry import se2
from fcslam.geometry.alignment import n_point_alignment
from fcslam.mission.edits import check_polygon
from fcslam.mission.mission_file import SavedMission
from fcslam.records import FloatArray, MapRegion, Pin, Placement, RegionUse, Veto
from fcslam.runs import Run


def check_closure(run: Run, decision: Veto | Pin) -> None:
    """Check that a run has the closure about which a user decides."""
    if decision.stamps is None:
        return
    named = Veto(decision.robot_i, decision.robot_j, decision.stamps)
    if not any(named.forbids(c.robot_i, c.stamp_i, c.robot_j, c.stamp_j) for c in run.closures):
        (at_i, at_j), (i, j) = decision.stamps, (decision.robot_i, decision.robot_j)
        raise InputError(
            f"there is no closure {i} {at_i:.6f} {j} {at_j:.6f}; copy both ends from a line of closures.csv"
        )


def region_in_map(
    run: Run, mission: SavedMission, map_index: int, use: RegionUse, name: str, polygon: Sequence[tuple[float, float]]
) -> MapRegion:
    """A region of a finished run, tied to the keyscan that is nearest to its centre.

    ``polygon``: corners (x, y) in ``map``, metres.
    """
    check_polygon(polygon)
    corners = np.array(polygon, dtype=np.float64)
    keyscans = list(_keyscans(run, mission, map_index))
    centre = corners.mean(axis=0)
    session, stamp, T_map_base = min(keyscans, key=lambda keyscan: float(np.hypot(*(keyscan[2][:2] - centre))))
    in_base = se2.transform(se2.inverse(T_map_base), corners).tolist()
    return MapRegion(use, name, session, stamp, tuple((x, y) for x, y in in_base))


def moved_map(run: Run, mission: SavedMission, map_index: int, T_new_map: FloatArray) -> Placement:
    """The placement that moves a map of a finished run by a motion.

    ``T_new_map``: the present frame in the new one, shape (3,), metres and radians.
    """
    session, stamp, T_map_base = next(_keyscans(run, mission, map_index))
    x, y, theta = se2.compose(T_new_map, T_map_base).tolist()
    return Placement(session, stamp, (x, y, theta))


def motion_to_points(points: Sequence[tuple[float, float]], targets: Sequence[tuple[float, float]]) -> FloatArray:
    """The motion that brings two or more points of a map nearest to their targets, in the least-squares sense, metres.

    Returns the present frame in the new one, shape (3,), metres and radians.
    """
    T_new_map = n_point_alignment(np.array(targets).reshape(-1, 2), np.array(points).reshape(-1, 2))
    if not np.isfinite(T_new_map).all():
        raise InputError("the points fix no rotation; give two or more that lie apart")
    return T_new_map


def _keyscans(run: Run, mission: SavedMission, map_index: int) -> Iterator[tuple[str, float, FloatArray]]:
    """Session, stamp and T_map_base of the keyscans of a map."""
    sessions = [trajectory for trajectory in run.trajectories.values() if len(trajectory.stamps)]
    known = sorted({trajectory.map_index for trajectory in sessions})
    if map_index not in known:
        raise InputError(f"there is no map {map_index}; there are {', '.join(map(str, known)) or 'none'}")
    for trajectory in (session for session in sessions if session.map_index == map_index):
        track = mission.tracks.get(trajectory.robot)
        every = np.ones(len(trajectory.stamps), bool)
        rows = every if track is None or len(track.stamps) != len(every) else ~track.T_keyscan_base.any(axis=1)
        for stamp, pose in zip(trajectory.stamps[rows].tolist(), trajectory.T_map_base[rows], strict=True):
            yield trajectory.robot, stamp, pose
