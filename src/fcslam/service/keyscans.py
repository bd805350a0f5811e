"""What the keyscans in a mission's store show: where a robot is now, what it sees, and both ends of a closure.

It follows the packets that arrived, without waiting for the next map.
"""

import numpy as np

from fcslam.cloud.sessions import robot_and_epoch
from fcslam.errors import InputError
from fcslam.geometry import se2
from fcslam.geometry.groups import SE2, group_of
from fcslam.lidar.scan import keyscan_points
from fcslam.lidar.submap import SPACING_M
from fcslam.maps.drawing import closure_png
from fcslam.maps.palette import ROBOTS, robot_colors
from fcslam.mission.mission_store import MissionStore
from fcslam.records import ConstraintKind, FloatArray
from fcslam.runs import ClosureRow, RobotTrajectory, Run

SCAN_POINTS = 1000
"""Largest number of points of a scan that viewers get."""
KEYSCANS = 31
"""Number of keyscans in a picture, for each end: about 4 m of path before it and after it."""
SAME_S = 1e-3
"""Stamps of a keyscan in packets, trajectories and closures differ by less."""


def live_pose(store: MissionStore, robot: str, epoch: int, drawn: RobotTrajectory) -> FloatArray:
    """Newest pose in the map, in the plane (3,) or in space (7,), metres and radians.

    It is the last pose that is ``drawn`` in the map, moved by the robot's motions since then.
    """
    poses = drawn.poses
    last: FloatArray = poses[-1]
    anchors = store.keyscans_near(robot, epoch, float(drawn.stamps[-1]), 1)
    if not anchors:
        return last
    anchor = anchors[0]
    pose, group = poses[drawn.nearest(anchor.stamp)], group_of(last)
    number = moved = anchor.id.number
    for step in store.constraints_since(robot, epoch, anchor.stamp):
        if step.kind is ConstraintKind.ODOMETRY and (step.i, step.j) == (moved, moved + 1):
            is_planar = group_of(step.T_i_j) is SE2
            pose, moved = group.compose(pose, group.from_plane(step.T_i_j) if is_planar else step.T_i_j), step.j
    return last if moved == number else pose


def live_scan(store: MissionStore, robot: str, epoch: int) -> FloatArray:
    """Points of the session's newest scan in the robot's base frame, shape (N, 2), metres; none before the first."""
    hello, keyscan = store.newest_hello(robot, epoch), store.newest_keyscan(robot, epoch)
    if hello is None or keyscan is None:
        return np.empty((0, 2))
    points: FloatArray = keyscan_points(keyscan, hello.lasers).points
    return points[:: -(-len(points) // SCAN_POINTS) or 1]


def overlay_png(store: MissionStore, run: Run, closure: ClosureRow) -> bytes:
    """Draw the submaps at both ends of a closure as its measurement places them.

    Raises:
        InputError: the mission holds no keyscans of an end.
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
        raise InputError(f"the mission holds no keyscans of {session}")
    scans = []
    for keyscan in store.keyscans_near(robot, epoch, stamp, KEYSCANS):
        nearest = trajectory.nearest(keyscan.stamp)
        if abs(trajectory.stamps[nearest] - keyscan.stamp) < SAME_S:
            points = keyscan_points(keyscan, hello.lasers).thinned(SPACING_M).points
            scans.append((keyscan.stamp, trajectory.T_map_base[nearest], points))
    if not scans or min(abs(at - stamp) for at, _, _ in scans) > SAME_S:
        raise InputError(f"the mission holds no keyscan of {session} at {stamp:.3f} s")
    _, anchor, _ = min(scans, key=lambda scan: abs(scan[0] - stamp))
    return np.concatenate([se2.transform(se2.between(anchor, pose), points) for _, pose, points in scans])
