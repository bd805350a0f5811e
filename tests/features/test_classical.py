"""ORB behind the interface of all detectors."""

import cv2
import numpy as np
import pytest

from fcslam.features.classical import ORB_VERSION, Orb
from fcslam.features.codes import mutual_matches
from fcslam.features.detector import decode_grey
from tests.features.pictures import picture
from tests.lidar.worlds import room

POSE = np.array([-1.5, -1.0, 0.2])


@pytest.fixture(scope="module")
def image():
    return picture(POSE, room())


def test_the_same_image_gives_the_same_features(image):
    first, second = Orb().detect(image), Orb().detect(image)
    assert np.array_equal(first.descriptors, second.descriptors)
    assert np.array_equal(first.keypoints_px, second.keypoints_px)
    assert Orb().version == ORB_VERSION


def test_features_are_as_many_as_asked_the_strongest_first_and_inside(image):
    features = Orb(most_features=120).detect(image)
    assert 60 < len(features.scores) <= 120
    assert features.descriptors.shape == (len(features.scores), 32)
    assert np.all(np.diff(features.scores) <= 0.0)
    assert np.all((features.keypoints_px >= 0.0) & (features.keypoints_px < image.shape[::-1]))


def test_a_shifted_image_gives_shifted_keypoints_with_the_same_codes(image):
    """(0, 0) is the centre of the first pixel, at every scale of the pyramid."""
    dx, dy = 24, 16
    shifted = np.roll(image, (dy, dx), (0, 1))
    a, b = Orb().detect(image), Orb().detect(shifted)
    matches = mutual_matches(a.descriptors, b.descriptors, 20)
    moved = b.keypoints_px[matches.pairs[:, 1]] - a.keypoints_px[matches.pairs[:, 0]]
    assert len(moved) > 100
    assert np.allclose(np.median(moved, axis=0), (dx, dy), atol=0.1)


@pytest.mark.parametrize("level", [0, 128])
def test_nothing_to_see_is_no_feature(level):
    features = Orb().detect(np.full((240, 320), level, np.uint8))
    assert features.descriptors.shape == (0, 32)
    assert features.keypoints_px.shape == (0, 2)


def test_broken_images_are_told(image):
    encoded = bytes(cv2.imencode(".png", image)[1])
    assert np.array_equal(decode_grey(encoded), image)
    assert decode_grey(b"\xff\xd8\xff\xe0" + bytes(50)) is None
    assert decode_grey(b"") is None


def test_coarse_keypoints_lie_where_fine_ones_do(image):
    """Mirrored pictures have mirrored keypoints: a position that is off to one side at coarse levels would show."""
    blurred = cv2.GaussianBlur(image, (0, 0), 2.5)  # corners of coarse levels
    there, back = (Orb(fast_threshold=3).detect(view).keypoints_px for view in (blurred, blurred[:, ::-1]))
    back = np.column_stack((image.shape[1] - 1 - back[:, 0], back[:, 1]))
    away = there[:, None] - back
    nearest = np.linalg.norm(away, axis=2).argmin(axis=1)
    offsets = away[np.arange(len(there)), nearest]
    near = np.linalg.norm(offsets, axis=1) < 4.0
    assert near.sum() > 40
    assert np.all(np.abs(offsets[near].mean(axis=0)) < 0.25)


def test_pictures_are_read_as_their_pixels_are_stored(image):
    """A camera's calibration knows nothing of a file's orientation tag."""
    jpeg = bytes(cv2.imencode(".jpg", image)[1])
    exif = b"Exif\0\0II*\0\x08\0\0\0\x01\0\x12\x01\x03\0\x01\0\0\0\x06\0\0\0\0\0\0\0"
    tagged = jpeg[:2] + b"\xff\xe1" + (len(exif) + 2).to_bytes(2, "big") + exif + jpeg[2:]
    assert np.array_equal(decode_grey(tagged), decode_grey(jpeg))
