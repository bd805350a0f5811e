"""Keypoints of images in metres: bearings from the camera, distances from the LiDAR."""

import numpy as np
import pytest

from fcslam.features.lidar_depth import LidarView, locate_among, locate_keypoints
from fcslam.features.lidar_depth import project as to_pixels
from fcslam.geometry import se2
from fcslam.records import CameraModel, Transform
from tests.features.pictures import CAMERA
from tests.lidar.worlds import LASER, box, cast, path, room, scan_at

POSE = np.array([-1.5, -1.0, 0.2])


def project(points, camera=CAMERA):
    """Pixels (K, 2) of points (K, 3) in ``base``, by the matrix of the camera: x right, y down, z ahead."""
    eye = np.array(camera.T_base_camera.translation_m)
    ahead, left, up = (points - eye).T
    return np.column_stack((camera.cx - camera.fx * left / ahead, camera.cy - camera.fy * up / ahead)).astype(
        np.float32
    )


def located(points, walls, pose=POSE, camera=CAMERA):
    scan = scan_at(pose, walls, LASER)
    return locate_keypoints(project(points, camera), camera, seen_in(scan))


def seen_in(scan):
    return LidarView(scan.points, scan.origin, LASER.angle_increment_rad)


def on_walls(pose, walls, angles_rad, heights):
    """Points (K, 3) in ``base`` where level rays from the camera meet the nearest wall."""
    eye = np.array(CAMERA.T_base_camera.translation_m[:2])
    distances = cast(se2.transform(pose, eye[None]), pose[2] + angles_rad, walls)
    return np.column_stack(
        (eye + distances[:, None] * np.column_stack((np.cos(angles_rad), np.sin(angles_rad))), heights)
    )


@pytest.mark.parametrize("pose", [POSE, np.array([2.0, 1.0, -2.4]), np.array([0.0, 3.0, 1.7])])
def test_points_of_walls_are_found_where_they_are(pose):
    """Between two beams the wall is straight, except where it turns a corner or ends."""
    rng = np.random.default_rng(3)
    points = on_walls(pose, room(), rng.uniform(-0.6, 0.6, 200), rng.uniform(0.1, 2.0, 200))
    found, placed = located(points, room(), pose)
    errors = np.linalg.norm(found[placed] - points[placed], axis=1)
    assert placed.mean() > 0.9
    assert np.median(errors) < 0.002
    assert np.mean(errors < 0.05) > 0.95


def test_floor_and_ceiling_lie_on_no_wall():
    walls = box(-4, -4, 4, 4)
    points = np.array([[2.0, 0.3, 0.0], [1.0, -0.2, 0.0], [2.0, 0.0, 3.0], [2.5, 0.5, 3.0], [3.5, 0.0, 1.0]])
    _, placed = located(points, walls, np.zeros(3))
    assert placed.tolist() == [False, False, False, False, True]


def test_where_nothing_returned_nothing_is_placed():
    walls = path((3, 0.2), (3, 4))
    points = np.array([[3.0, 1.0, 1.0], [3.0, -1.0, 1.0]])
    _, placed = located(points, walls, np.zeros(3))
    assert placed.tolist() == [True, False]
    _, placed = locate_keypoints(project(points), CAMERA, LidarView(np.empty((0, 2)), np.zeros(2), 0.02))
    assert not placed.any()


def test_an_edge_belongs_to_what_stands_in_front():
    """A door post 1 m in front of a wall: its edge is not smeared between the two."""
    walls = np.vstack((path((2.0, -1.0), (2.0, 0.013)), path((3.0, -3.0), (3.0, 3.0))))
    edge = np.array([[2.0, 0.012 + 0.004 * k, 1.0] for k in range(3)])
    found, placed = located(edge, walls, np.zeros(3))
    assert np.all(np.abs(found[placed][:, 0] - 2.0) < 0.1)
    between = np.array([[2.5, 0.03, 1.0]])
    found, placed = located(between, walls, np.zeros(3))
    assert not placed[0] or abs(found[0, 0] - 3.0) < 0.1 or abs(found[0, 0] - 2.0) < 0.1


def test_nothing_is_placed_across_an_opening():
    """A crack in a wall, behind it a hall where nothing returns: what is seen through it lies nowhere."""
    walls = np.vstack((path((4.0, -3.0), (4.0, -0.15)), path((4.0, 0.15), (4.0, 3.0))))
    through = np.array([[4.0, y, 1.0] for y in (-0.05, 0.0, 0.05)])
    _, placed = located(through, walls, np.zeros(3))
    assert not placed.any()
    beside = np.array([[4.0, y, 1.0] for y in (-0.6, 0.6)])
    assert located(beside, walls, np.zeros(3))[1].all()


def test_the_mounting_of_the_camera_is_heeded():
    """Turned to the left on its mast, and pitched down by 10 degrees."""
    walls = box(-4, -4, 4, 4)
    yaw = np.array([0.0, 0.0, np.sin(np.pi / 4), np.cos(np.pi / 4)])
    left = product(yaw, np.array(CAMERA.T_base_camera.rotation))
    turned = CameraModel(320, 240, 200.0, 200.0, 159.5, 119.5, Transform((0.0, 0.1, 0.6), tuple(left)))
    centre = np.array([[159.5, 119.5]], np.float32)
    scan = scan_at(np.zeros(3), walls, LASER)
    found, placed = locate_keypoints(centre, turned, seen_in(scan))
    assert placed[0]
    assert np.allclose(found[0], (0.0, 4.0, 0.6), atol=0.01)
    pitch = np.array([0.0, np.sin(np.deg2rad(5)), 0.0, np.cos(np.deg2rad(5))])
    down = product(pitch, np.array(CAMERA.T_base_camera.rotation))
    lowered = CameraModel(320, 240, 200.0, 200.0, 159.5, 119.5, Transform((0.0, 0.0, 0.9), tuple(down)))
    found, placed = locate_keypoints(centre, lowered, seen_in(scan))
    assert placed[0]
    assert np.allclose(found[0], (4.0, 0.0, 0.9 - 4.0 * np.tan(np.deg2rad(10))), atol=0.01)


def product(p, q):
    """Of two quaternions (x, y, z, w)."""
    (a, b), (s, t) = (p[:3], q[:3]), (p[3], q[3])
    return np.append(s * b + t * a + np.cross(a, b), s * t - a @ b)


def test_projection_is_that_of_the_matrix_and_knows_what_is_behind():
    points = np.array([[2.0, 0.3, 0.9], [4.0, -1.0, 0.2], [-1.0, 0.0, 0.6]])
    pixels = to_pixels(points, CAMERA)
    assert pixels[:2] == pytest.approx(project(points, CAMERA)[:2], abs=1e-3)
    assert np.isnan(pixels[2]).all()


def test_what_one_lidar_does_not_see_another_one_may():
    rng = np.random.default_rng(3)
    points = on_walls(POSE, room(), rng.uniform(-0.6, 0.6, 200), rng.uniform(0.1, 2.0, 200))
    whole = seen_in(scan_at(POSE, room(), LASER))
    half = len(whole.returns) // 2
    sides = [whole._replace(returns=part) for part in (whole.returns[:half], whole.returns[half:])]
    pixels = project(points)
    expected, placed = locate_keypoints(pixels, CAMERA, whole)
    found, is_found = locate_among(pixels, CAMERA, sides)
    assert np.sum(placed & ~is_found) <= 3  # between the two halves
    assert 0 < np.sum(locate_among(pixels, CAMERA, sides[:1])[1]) < np.sum(is_found)
    assert found[is_found] == pytest.approx(expected[is_found])
