"""Motions that the keypoints of two places propose, planted ones and those of pictures."""

from dataclasses import replace

import numpy as np
import pytest

from fcslam.features.classical import Orb
from fcslam.features.lidar_depth import LidarView, locate_keypoints
from fcslam.geometry import se2
from fcslam.places import motions
from fcslam.places.motions import propose_motions
from fcslam.records import Channel, KeyscanId, Place, frozen
from tests.features.pictures import CAMERA, picture
from tests.lidar.worlds import LASER, room, scan_at

T_A_B = np.array([0.7, -0.4, 0.5])


def planted(count=40, channel=Channel.CAMERA, seed=0):
    """Two places with the same codes, b's keypoints lie T_A_B apart from a's."""
    rng = np.random.default_rng(seed)
    codes = rng.integers(0, 256, (count, 32), np.uint8)
    points = np.column_stack((rng.uniform(1, 6, count), rng.uniform(-3, 3, count), rng.uniform(0, 2, count)))
    seen = points.copy()
    seen[:, :2] = se2.transform(se2.inverse(T_A_B), points[:, :2])
    axes = 3 if channel is Channel.CAMERA else 2
    return [
        Place(KeyscanId(robot, 0), channel, "v", 0, 0, frozen(at[:, :axes], np.float32), codes)
        for robot, at in (("a", points), ("b", seen))
    ]


def viewed(robot, pose):
    """A robot's view of the room, as a camera place."""
    features = Orb().detect(picture(pose, room()))
    scan = scan_at(pose, room(), LASER)
    positions, placed = locate_keypoints(
        features.keypoints_px, CAMERA, LidarView(scan.points, scan.origin, LASER.angle_increment_rad)
    )
    keypoints, codes = frozen(positions[placed], np.float32), features.descriptors[placed]
    return Place(KeyscanId(robot, 0), Channel.CAMERA, "v", 0, 0, keypoints, codes)


@pytest.mark.parametrize("channel", Channel)
def test_planted_motions_are_found(channel):
    first = propose_motions(*planted(channel=channel))[0]
    assert np.allclose(first.T_a_b, T_A_B, atol=1e-5)
    assert first.share == 1.0


@pytest.mark.parametrize(("height_m", "count"), [(0.05, 1), (0.3, 0)])
def test_keypoints_at_other_heights_do_not_match(height_m, count):
    a, b = planted()
    lifted = replace(b, keypoints=frozen(b.keypoints + np.array([0.0, 0.0, height_m]), np.float32))
    assert len(propose_motions(a, lifted)) == count


@pytest.mark.parametrize("pose_b", [(-1.0, -0.6, 0.45), (-0.6, -1.2, 0.1), (-1.9, -1.1, 0.0)])
def test_pictures_of_one_room_tell_how_their_robots_stood(pose_b):
    pose_a = np.array([-1.5, -1.0, 0.2])
    first = propose_motions(viewed("a", pose_a), viewed("b", np.array(pose_b)))[0]
    off = se2.between(se2.between(pose_a, np.array(pose_b)), first.T_a_b)
    assert np.hypot(off[0], off[1]) < 0.06
    assert abs(off[2]) < 0.02


def test_pictures_of_two_walls_tell_nothing():
    assert propose_motions(viewed("a", np.array([-1.5, -1.0, 0.2])), viewed("b", np.array([-1.5, -1.0, 2.9]))) == []


def test_information_is_that_of_the_keypoints():
    """Against the second derivative of half the squared distances, and no more than of ten keypoints."""
    a, b = planted(count=10)
    (first, *_) = propose_motions(a, b)

    def cost(pose):
        return 0.5 * np.sum((se2.transform(pose, b.keypoints[:, :2]) - a.keypoints[:, :2]) ** 2)

    step, numeric = 1e-3, np.zeros((3, 3))
    for r, dr in enumerate(step * np.eye(3)):
        for c, dc in enumerate(step * np.eye(3)):
            signs = [cost(T_A_B + s * dr + t * dc) * s * t for s in (1, -1) for t in (1, -1)]
            numeric[r, c] = sum(signs) / (4 * step**2)
    assert np.allclose(first.information, numeric / motions.KEYPOINT_SIGMA_M**2, rtol=1e-3, atol=1.0)
    many = propose_motions(*planted(count=80))[0]
    assert many.information[0, 0] == pytest.approx(first.information[0, 0])


def test_lidar_keypoints_add_no_information():
    assert not propose_motions(*planted(channel=Channel.LIDAR))[0].information.any()
