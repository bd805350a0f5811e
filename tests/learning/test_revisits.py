"""Correspondences of two views of a room whose points and poses are known."""

import numpy as np
import pytest

from fcslam.features.detector import ImageFeatures
from fcslam.features.lidar_depth import LidarView, project
from fcslam.geometry import se2
from fcslam.learning.revisits import (
    FARTHEST_M,
    FEWEST_ALIKE,
    FEWEST_SHARED,
    Keyframe,
    correspond,
    predict,
    revisits_in_map,
)
from tests.features.pictures import CAMERA
from tests.lidar.worlds import LASER, box, room, scan_at

FIRST, SECOND = np.array([-1.5, -1.0, 0.2]), np.array([-1.0, -0.6, 0.0])
BLANK = np.zeros((CAMERA.height, CAMERA.width), np.uint8)
NUMBERS = 400


def world_points(walls, seed=1):
    """Points (N, 3) on the walls of the room."""
    rng = np.random.default_rng(seed)
    lengths = np.hypot(*(walls[:, 2:] - walls[:, :2]).T)
    wall = walls[rng.choice(len(walls), NUMBERS, p=lengths / lengths.sum())]
    share = rng.uniform(0.0, 1.0, (NUMBERS, 1))
    return np.column_stack((wall[:, :2] + share * (wall[:, 2:] - wall[:, :2]), rng.uniform(0.1, 1.8, NUMBERS)))


def code_of(numbers, seed=5, flips=0.0):
    """The code of each point; a share of its bits is flipped by the view."""
    codes = np.random.default_rng(7).integers(0, 2, (NUMBERS, 256))[numbers]
    flipped = np.random.default_rng(seed).random(codes.shape) < flips
    return np.packbits(codes ^ flipped, axis=1).astype(np.uint8)


def view(pose, walls, points, seed=1, other_codes=()):
    """A keyframe, and which point each of its keypoints is; ``other_codes``: points that this view codes otherwise."""
    local = points.copy()
    local[:, :2] = se2.transform(se2.inverse(pose), points[:, :2])
    pixels = project(local, CAMERA)
    # A point is seen if nothing is before it, by the distances of the LiDAR in its direction.
    inside = np.all((pixels > 5) & (pixels < [CAMERA.width - 6, CAMERA.height - 6]), axis=1)
    numbers = np.flatnonzero(inside)
    scan = scan_at(pose, walls, LASER)
    lidar = LidarView(scan.points, scan.origin, LASER.angle_increment_rad)
    codes = code_of(numbers, seed, flips=0.1)
    strange = np.isin(numbers, other_codes)
    codes[strange] = np.random.default_rng(seed + 50).integers(0, 256, (strange.sum(), 32))
    scores = np.linspace(1.0, 0.1, len(numbers), dtype=np.float32)
    features = ImageFeatures(pixels[numbers].astype(np.float32), scores, codes)
    frame = Keyframe.of(BLANK, features, CAMERA, (lidar,))
    seen = frame.placed & (np.linalg.norm(frame.positions - local[numbers], axis=1) < 0.1)
    rows = np.flatnonzero(seen)
    return Keyframe.of(BLANK, features.take(rows), CAMERA, (lidar,)), numbers[rows]


def correspondences(motion_error=(0.0, 0.0, 0.0), other_codes=(), walls=None):
    walls = room() if walls is None else walls
    points = world_points(room())
    first, of_first = view(FIRST, walls, points)
    second, of_second = view(SECOND, walls, points, 2, other_codes)
    T = se2.compose(se2.between(FIRST, SECOND), motion_error)
    found = correspond(first, second, T)
    return of_first, of_second, found


def test_the_points_that_both_views_show_are_found():
    of_first, of_second, found = correspondences()
    shared = set(of_first) & set(of_second)
    assert len(shared) > 40
    right = of_first[found[:, 0]] == of_second[found[:, 1]]
    assert right.mean() > 0.98
    assert right.sum() > 0.9 * len(shared)


@pytest.mark.parametrize("error", [(0.05, 0.0, 0.0), (0.0, -0.05, 0.01), (0.03, 0.03, -0.02)])
def test_an_inexact_pose_is_corrected_and_codes_that_differ_are_matched_by_place(error):
    other = np.arange(0, NUMBERS, 3)
    of_first, of_second, found = correspondences(error, other)
    right = of_first[found[:, 0]] == of_second[found[:, 1]]
    assert right.mean() > 0.95
    shared = np.intersect1d(of_first, of_second)
    strange = np.isin(of_first[found[right, 0]], other)
    assert strange.sum() > 0.7 * np.isin(shared, other).sum() > 5


def test_a_point_behind_a_box_is_not_shown():
    screen = np.vstack((room(), box(0.2, -2.0, 0.5, 1.5)))
    walls, points = room(), world_points(room())
    first, _ = view(FIRST, walls, points)
    free, _ = view(SECOND, walls, points, 2)
    hidden, _ = view(SECOND, screen, points, 2)
    T = se2.between(FIRST, SECOND)
    _, without = predict(first, free, T)
    _, behind = predict(first, hidden, T)
    assert behind.sum() < 0.5 * without.sum()
    assert not np.any(behind & ~without)


def test_views_without_like_codes_share_nothing():
    _, _, found = correspondences(other_codes=np.arange(NUMBERS))
    assert len(found) == 0
    assert FEWEST_ALIKE > 0


def test_a_wrong_pose_gives_hardly_anything():
    of_first, of_second, found = correspondences((0.0, 0.0, 0.3))
    right = of_first[found[:, 0]] == of_second[found[:, 1]]
    assert right.sum() == len(right) == 0


def test_keyframes_near_one_another_in_the_map_are_paired_from_any_time():
    walls, points = room(), world_points(room())
    poses = np.array([FIRST, [1.8, 1.2, np.pi], SECOND])
    views = [view(pose, walls, points, seed) for seed, pose in enumerate(poses)]
    found = revisits_in_map([frame for frame, _ in views], poses)
    assert [(i, j) for i, j, _ in found] == [(0, 2)]  # the one between them looks the other way
    rows = found[0][2]
    assert len(rows) >= FEWEST_SHARED
    assert np.mean(views[0][1][rows[:, 0]] == views[2][1][rows[:, 1]]) > 0.98
    far = np.array([FIRST, [1.8, 1.2, np.pi], [FIRST[0] + FARTHEST_M + 1.0, 0.0, 0.0]])
    assert not revisits_in_map([frame for frame, _ in views], far)
