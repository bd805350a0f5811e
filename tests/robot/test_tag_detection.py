"""Tags in images are where they were drawn, with the errors that they state; ambiguous poses are left out."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from worlds.wall_tags import WallTag, draw_tags

from fcslam.config import parse
from fcslam.errors import InputError
from fcslam.geometry import se2
from fcslam.lab.simulation.simulated_fleet import CameraSettings
from fcslam.lidar.frontend import ScanPose
from fcslam.records import CameraImage, Channel, KeyscanId, LaserModel, LaserScan, Tag, TagFamily, TagSighting
from fcslam.robot.backend import NewImage, RobotBackend, SessionConfig
from fcslam.robot.frontend import RobotConfig
from fcslam.robot.tag_detection import TagDetector, TagsConfig
from fcslam.wire.limits import MAXIMUM_TAGS

pytestmark = pytest.mark.slow

CAMERA = CameraSettings(width=640, height=480).model()
TAG = WallTag(7, (0.0, 0.0, 0.0))
NO_WALLS = np.zeros((0, 4))


def seen(T_building_base, tags=(TAG,), camera=CAMERA, size_m=TAG.size_m, family=TAG.family, walls=NO_WALLS):
    picture = np.full((CAMERA.height, CAMERA.width, 1), 140.0)
    draw_tags(picture, CAMERA, T_building_base, tags, walls)
    picture += np.random.default_rng(0).normal(0.0, 2.0, picture.shape)
    _, encoded = cv2.imencode(".jpg", np.clip(picture, 0, 255).astype(np.uint8))
    detector = TagDetector(TagsConfig(family=family, size_m=size_m))
    return list(detector.find(CameraImage(0.0, bytes(encoded), camera, None), KeyscanId("anna", 3), np.zeros(3)))


def robot_at(distance_m, direction_rad, bearing_rad):
    """Pose from which the tag is so far away, seen from this direction, at this bearing of the robot."""
    x, y = distance_m * np.cos(direction_rad), distance_m * np.sin(direction_rad)
    return np.array((x, y, np.arctan2(-y, -x) - bearing_rad))


def test_a_tag_is_where_it_was_drawn_within_the_stated_errors():
    rng = np.random.default_rng(1)
    drawn = [robot_at(*rng.uniform((0.9, 0.4, -0.3), (2.5, 1.0, 0.3))) for _ in range(30)]
    found = [(T, one) for T in drawn for one in seen(T)]
    assert len(found) > 20
    errors = np.array([se2.log(se2.between(one.T_base_tag, se2.between(T, np.zeros(3)))) for T, one in found])
    chi2 = [error @ one.information @ error for error, (_, one) in zip(errors, found, strict=True)]
    assert all(one.tag == (TagFamily.APRILTAG_36H11, 7) and one.id == ("anna", 3) for _, one in found)
    assert np.hypot(*errors[:, :2].T).max() < 0.05
    assert np.percentile(chi2, 90) < 7.8, "95 % of chi-square with three degrees of freedom"


def test_a_pose_that_the_corners_leave_open_is_not_sent():
    """Far away and a little oblique, the mirrored pose fits as well; whatever is sent has the true heading."""
    for direction in np.linspace(-0.5, 0.5, 21):
        for one in seen(T := robot_at(3.0, direction, 0.0)):
            off = se2.wrap_angle(one.T_base_tag[2] - se2.between(T, np.zeros(3))[2])
            assert abs(off) < 0.15


def test_a_motion_since_the_keyscan_moves_the_tag():
    T_keyscan_image = np.array((0.3, -0.1, 0.2))
    (plain,) = seen(robot_at(1.5, 0.7, 0.0))
    detector, image = TagDetector(TagsConfig(size_m=TAG.size_m)), np.full((480, 640, 1), 140.0)
    draw_tags(image, CAMERA, robot_at(1.5, 0.7, 0.0), (TAG,), NO_WALLS)
    _, encoded = cv2.imencode(".png", image.astype(np.uint8))
    (moved,) = detector.find(CameraImage(0.0, bytes(encoded), CAMERA, None), KeyscanId("a", 0), T_keyscan_image)
    assert moved.T_base_tag == pytest.approx(se2.compose(T_keyscan_image, plain.T_base_tag), abs=0.02)


def test_twins_hidden_tags_other_families_and_other_images_are_no_sightings():
    T = robot_at(1.5, 0.7, 0.0)
    beside = replace(TAG, T_building_tag=(0.0, 0.5, 0.0))
    assert seen(T, (TAG, beside)) == [], "one number at two places of an image"
    assert len(seen(T, (TAG, replace(beside, number=8)))) == 2
    assert seen(T, walls=np.array([(0.4, -2.0, 0.4, 2.0)])) == []
    assert seen(T, family=TagFamily("4x4_50")) == []
    assert seen(T, camera=replace(CAMERA, width=320)) == [], "a picture of another size than the calibration's"


def test_aruco_tags_are_read():
    tag = replace(TAG, family=TagFamily("6x6_250"), number=240)
    (one,) = seen(robot_at(1.2, 0.7, 0.0), (tag,), family=tag.family)
    assert one.tag == (TagFamily("6x6_250"), 240)


def test_a_keyscan_near_a_board_of_many_tags_sends_as_many_as_the_cloud_takes(monkeypatch):
    numbers = iter((range(20), range(10, 36), range(36)))

    def find(_detector, _image, keyscan, T_keyscan_image):
        for number in next(numbers):
            yield TagSighting(keyscan, Tag(TagFamily.APRILTAG_36H11, number), T_keyscan_image, np.eye(3))

    monkeypatch.setattr(TagDetector, "find", find)
    backend = RobotBackend("anna", SessionConfig(channels=(Channel.LIDAR,), tags=TagsConfig(size_m=0.1)))
    laser = LaserModel(4, 0.0, 1.0, 10.0)
    scan = LaserScan(0.0, np.zeros(4, np.float32), laser, np.zeros(3))
    image = CameraImage(0.0, b"", CAMERA, None)
    sent = [
        [one.tag.number for one in backend.process(NewImage(image, scan, ScanPose(0.0, keyscan, np.zeros(3)), (scan,)))]
        for keyscan in (0, 0, 1)
    ]
    assert sent == [list(range(20)), list(range(20, MAXIMUM_TAGS)), list(range(MAXIMUM_TAGS))]


@pytest.mark.parametrize(
    ("settings", "reason"),
    [
        ({"tags": {"size_m": 0}}, "tags.size_m"),
        ({"tags": {"size_m": float("nan")}}, "tags.size_m"),
        ({"tags": {"family": "apriltag_99h9", "size_m": 0.2}}, "tags.family"),
        ({"channels": ["lidar", "tag"]}, "set robot.tags.size_m"),
    ],
)
def test_bad_settings_get_one_line(settings, reason):
    with pytest.raises(InputError, match=reason) as error:
        parse(RobotConfig, settings, "robot")
    assert "\n" not in str(error.value)
