"""A building with walls, its plan, and a map of it by ideal scans."""

from itertools import pairwise
from types import SimpleNamespace

import cv2
import numpy as np

from fcslam.anchoring.anchors import anchored
from fcslam.cloud.report import fuse_members
from fcslam.cloud.result import FleetResult, MappedRobot
from fcslam.geometry import se2
from fcslam.graph.pose_graph import Edge, PoseGraph
from fcslam.lidar.occupancy import OccupancyConfig
from fcslam.maps.occupancy_map import Occupancy, OccupancyMap
from fcslam.records import Keyscan, KeyscanId, LaserModel, frozen
from tests.lidar.worlds import ranges

WALLS = np.array(
    [
        (0, 0, 16, 0), (16, 0, 16, 7), (16, 7, 11, 7), (11, 7, 11, 10), (11, 10, 0, 10), (0, 10, 0, 0),
        (0, 6, 3, 6), (4.2, 6, 8, 6), (8, 6, 8, 10), (5, 0, 5, 3), (10, 0, 10, 2.5), (10, 3.8, 10, 7),
        (12, 3.8, 16, 3.8), (2, 8, 3, 8.6),
    ],
    dtype=float,
)  # fmt: skip
"""Segments x1 y1 x2 y2, metres."""
OTHER_WALLS = np.array(
    [
        (0, 0, 14, 0), (14, 0, 14, 11), (14, 11, 0, 11), (0, 11, 0, 0), (0, 4, 6, 4), (7.5, 4, 14, 4), (6, 4, 6, 11),
        (9, 4, 9, 8), (6, 8, 9, 8),
    ],
    dtype=float,
)  # fmt: skip
"""Those of another building."""
PATH = [(1, 3), (4, 4.5), (3.6, 7.5), (6.5, 8.5), (3.6, 7), (4, 4.5), (8, 4.5), (9, 8.5), (9, 3.2), (11, 3), (15, 2),
        (11, 3), (11, 5.5), (15, 5.5)]  # fmt: skip
LASER = LaserModel(360, -np.pi, np.radians(1.0), 20.0)
STEP_M = 0.5
CELL_M, MARGIN_M, THICKNESS_M = 0.02, 0.5, 0.12


def outlines(walls, thickness_m=THICKNESS_M):
    """The walls as rectangles, shape (N, 4, 2), all of one thickness, or each of its own, shape (N, 1)."""
    start, end = walls[:, :2], walls[:, 2:]
    along = 0.5 * thickness_m * (end - start) / np.linalg.norm(end - start, axis=1, keepdims=True)
    across = np.column_stack((-along[:, 1], along[:, 0]))
    ends = start - along, end + along
    return np.stack((ends[0] - across, ends[1] - across, ends[1] + across, ends[0] + across), axis=1)


def sides(walls, thickness_m=THICKNESS_M):
    """The sides of these rectangles as segments, shape (4 N, 4)."""
    corners = outlines(walls, thickness_m)
    return np.concatenate((corners, np.roll(corners, -1, axis=1)), axis=2).reshape(-1, 4)


def plan_of(walls=WALLS, thickness_m=THICKNESS_M):
    low, high = walls.reshape(-1, 2).min(axis=0) - MARGIN_M, walls.reshape(-1, 2).max(axis=0) + MARGIN_M
    columns, rows = np.ceil((high - low) / CELL_M).astype(int)
    cells = np.full((rows, columns), Occupancy.FREE, np.uint8)
    for corners in outlines(walls, thickness_m):
        cv2.fillPoly(
            cells, [np.round(((corners - low) / CELL_M - 0.5) * 16).astype(np.int32)], int(Occupancy.OCCUPIED), shift=4
        )
    return OccupancyMap(cells, CELL_M, (float(low[0]), float(low[1])))


def true_poses():
    corners = np.array(PATH, float)
    legs = [np.linspace(a, b, max(2, int(np.hypot(*(b - a)) / STEP_M)), endpoint=False)
            for a, b in pairwise(corners)]  # fmt: skip
    xy = np.concatenate(legs)
    return np.column_stack((xy, np.linspace(0.0, 3.0, len(xy))))


def ranges_at(pose, walls):
    """Distance of the nearest wall along each beam."""
    return ranges(pose, walls, LASER)[0]


def mapped(T_map_building=(3.0, -2.0, 0.6), scale=1.0, walls=WALLS, drift_rad=0.0, thickness_m=THICKNESS_M):
    """The result of one robot in ``walls``, in another frame, with all lengths ``scale`` times too long, and with a
    heading that drifts over the drive."""
    true = true_poses()
    rng, seen = np.random.default_rng(0), sides(walls, thickness_m)
    keyscans = tuple(
        Keyscan(
            KeyscanId("anna", k), float(k),
            frozen(scale * (ranges_at(pose, seen) + rng.normal(0, 0.005, 360)), np.float32),
        )
        for k, pose in enumerate(true)
    )  # fmt: skip
    steps = se2.relative(true) * (scale, scale, 1.0) + (0.0, 0.0, drift_rad / len(true))
    poses = [np.array(T_map_building, float)]
    for step in steps:
        poses.append(se2.compose(poses[-1], step))
    information = np.diag((1e4, 1e4, 4e4))
    edges = [Edge(k, k + 1, step, information, robust=False) for k, step in enumerate(steps)]
    poses = np.array(poses)
    robot = MappedRobot(
        "anna", 0, frozen(np.arange(len(true), dtype=float)), keyscans, frozen(poses), frozen(poses),
        frozen(np.arange(len(true)), np.int64), (LASER,),
    )  # fmt: skip
    return FleetResult((robot,), (), PoseGraph(poses, edges)), true


def off_m(placing, true):
    """Distance of each pose from the truth."""
    (robot,) = placing.result.robots
    return np.hypot(*(robot.T_map_base[:, :2] - true[:, :2]).T)


def anchored_map(result, anchors, by_hand=()):
    """A result in the coordinates of the building, and its files."""
    placed, files = anchored(result, anchors, by_hand, lambda members: fuse_members(members, OccupancyConfig()))
    return SimpleNamespace(result=placed, files=files)
