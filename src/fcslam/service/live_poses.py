"""Where a robot is now, and what it sees: by the packets that arrived, without waiting for the next map."""

import numpy as np

from fcslam.geometry import se2
from fcslam.lidar.scan import keyscan_points
from fcslam.mission.mission_store import MissionStore
from fcslam.records import ConstraintKind, FloatArray
from fcslam.runs import RobotTrajectory

SCAN_POINTS = 1000
"""Largest number of points of a scan that viewers get."""


def live_pose(store: MissionStore, robot: str, epoch: int, drawn: RobotTrajectory) -> FloatArray:
    """Newest pose in the map, shape (3,), metres and radians.

    It is the last pose that is ``drawn`` in the map, moved by the robot's motions since then.
    """
    last: FloatArray = drawn.T_map_base[-1]
    anchors = store.keyscans_near(robot, epoch, float(drawn.stamps[-1]), 1)
    if not anchors:
        return last
    anchor = anchors[0]
    pose = drawn.T_map_base[int(np.argmin(np.abs(drawn.stamps - anchor.stamp)))]
    number = moved = anchor.id.number
    for step in store.constraints_since(robot, epoch, anchor.stamp):
        if step.kind is ConstraintKind.ODOMETRY and (step.i, step.j) == (moved, moved + 1):
            pose, moved = se2.compose(pose, step.T_i_j), step.j
    return last if moved == number else pose


def live_scan(store: MissionStore, robot: str, epoch: int) -> FloatArray:
    """Points of the session's newest scan in the robot's base frame, shape (N, 2), metres; none before the first."""
    hello, keyscan = store.newest_hello(robot, epoch), store.newest_keyscan(robot, epoch)
    if hello is None or keyscan is None:
        return np.empty((0, 2))
    points: FloatArray = keyscan_points(keyscan, hello.lasers).points
    return points[:: -(-len(points) // SCAN_POINTS) or 1]
