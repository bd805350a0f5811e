"""ORB behind the interface of all detectors."""

import cv2
import numpy as np
import pytest
from features.pictures import picture
from lidar.worlds import room

from fcslam.features.classical import ORB_VERSION, Orb, OrbConfig
from fcslam.features.codes import mutual_matches
from fcslam.features.detector import decode_grey

POSE = np.array([-1.5, -1.0, 0.2])


@pytest.fixture(scope="module")
def image():
    return picture(POSE, room())


def test_the_same_image_gives_the_same_features(image):
    first, second = Orb(OrbConfig()).detect(image), Orb(OrbConfig()).detect(image)
    assert np.array_equal(first.descriptors, second.descriptors)
    assert np.array_equal(first.keypoints_px, second.keypoints_px)
    assert Orb(OrbConfig()).version == ORB_VERSION


def test_features_are_as_many_as_asked_the_strongest_first_and_inside(image):
    features = Orb(OrbConfig(most_features=120)).detect(image)
    assert 60 < len(features.scores) <= 120
    assert features.descriptors.shape == (len(features.scores), 32)
    assert np.all(np.diff(features.scores) <= 0.0)
    assert np.all((features.keypoints_px >= 0.0) & (features.keypoints_px < image.shape[::-1]))


def test_a_shifted_image_gives_shifted_keypoints_with_the_same_codes(image):
    """(0, 0) is the centre of the first pixel, at every scale of the pyramid."""
    dx, dy = 24, 16
    shifted = np.roll(image, (dy, dx), (0, 1))
    a, b = Orb(OrbConfig()).detect(image), Orb(OrbConfig()).detect(shifted)
    matches = mutual_matches(a.descriptors, b.descriptors, 20)
    moved = b.keypoints_px[matches.pairs[:, 1]] - a.keypoints_px[matches.pairs[:, 0]]
    assert len(moved) > 100
    assert np.allclose(np.median(moved, axis=0), (dx, dy), atol=0.1)


@pytest.mark.parametrize("level", [0, 128])
def test_nothing_to_see_is_no_feature(level):
    features = Orb(OrbConfig()).detect(np.full((240, 320), level, np.uint8))
    assert features.descriptors.shape == (0, 32)
    assert features.keypoints_px.shape == (0, 2)


def test_broken_images_are_told(image):
    encoded = bytes(cv2.imencode(".png", image)[1])
    assert np.array_equal(decode_grey(encoded), image)
    assert decode_grey(b"\xff\xd8\xff\xe0" + bytes(50)) is None
    assert decode_grey(b"") is None
