"""The two submaps that a closure lays on each other, from the keyscans that a mission holds."""

import numpy as np

from fcslam.cloud.sessions import robot_and_epoch
from fcslam.errors import EvaluationError
from fcslam.geometry import se2
from fcslam.lidar.scan import keyscan_points
from fcslam.lidar.submap import SPACING_M
from fcslam.maps.drawing import closure_png
from fcslam.maps.palette import ROBOTS, robot_colors
from fcslam.mission.mission_store import MissionStore
from fcslam.records import FloatArray
from fcslam.runs import ClosureRow, Run

KEYSCANS = 31
"""Number of keyscans in a picture, for each end: about 4 m of path before it and after it."""
SAME_S = 1e-3
"""Stamps of a keyscan in packets, trajectories and closures differ by less."""


def overlay_png(store: MissionStore, run: Run, closure: ClosureRow) -> bytes:
    """Draw the submaps at both ends of a closure as its measurement places them.

    Raises:
        EvaluationError: the mission holds no keyscans of an end.
    """
    i = _submap(store, run, closure.robot_i, closure.stamp_i)
    j = se2.transform(closure.T_i_j, _submap(store, run, closure.robot_j, closure.stamp_j))
    colors = robot_colors(run.trajectories)
    first, second = colors[closure.robot_i], colors[closure.robot_j]
    if first == second:  # both ends are the same robot's
        second = next(color for color in ROBOTS if color != first)
    return closure_png((i, j), (np.zeros(3), closure.T_i_j), (first, second))


def _submap(store: MissionStore, run: Run, session: str, stamp: float) -> FloatArray:
    """Returns around a keyscan in its base, shape (N, 2), metres; poses are those of the run."""
    robot, epoch = robot_and_epoch(session)
    hello, trajectory = store.newest_hello(robot, epoch), run.trajectories.get(session)
    if hello is None or trajectory is None:
        raise EvaluationError(f"the mission holds no keyscans of {session}")
    scans = []
    for keyscan in store.keyscans_near(robot, epoch, stamp, KEYSCANS):
        nearest = int(np.argmin(np.abs(trajectory.stamps - keyscan.stamp)))
        if abs(trajectory.stamps[nearest] - keyscan.stamp) < SAME_S:
            points = keyscan_points(keyscan, hello.lasers).thinned(SPACING_M).points
            scans.append((keyscan.stamp, trajectory.T_map_base[nearest], points))
    if not scans or min(abs(at - stamp) for at, _, _ in scans) > SAME_S:
        raise EvaluationError(f"the mission holds no keyscan of {session} at {stamp:.3f} s")
    _, anchor, _ = min(scans, key=lambda scan: abs(scan[0] - stamp))
    return np.concatenate([se2.transform(se2.between(anchor, pose), points) for _, pose, points in scans])
