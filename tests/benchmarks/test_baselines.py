"""Detectors that the evaluation compares with."""

import numpy as np
import pytest
from evaluation.baselines import Fast, Harris, ShiTomasi, Sift, logit_features

from fcslam.features.detector import OnnxConfig, OnnxDetector
from tests.features.networks import tiny_network
from tests.features.pictures import picture
from tests.lidar.worlds import room


@pytest.fixture(scope="module")
def image():
    return picture(np.array([-1.5, -1.0, 0.2]), room())


@pytest.mark.parametrize("detector", [Fast(), Harris(), ShiTomasi(), Sift(500)], ids=lambda one: type(one).__name__)
def test_detectors_to_compare_with_find_what_a_shifted_image_has_shifted(detector, image):
    found, shifted = detector.detect(image), detector.detect(np.roll(image, (6, 9), (0, 1)))
    assert len(found.scores) > 50
    assert np.all(np.diff(found.scores) <= 0)
    assert np.all((found.keypoints_px >= 0) & (found.keypoints_px < image.shape[::-1]))
    gaps = np.linalg.norm(found.keypoints_px[:50, None] + (9, 6) - shifted.keypoints_px, axis=2).min(axis=1)
    assert np.mean(gaps < 1.0) > 0.8
    empty = detector.detect(np.full((64, 64), 100, np.uint8))
    assert empty.keypoints_px.shape == (0, 2)


def test_logits_are_floats_of_unit_length_whose_signs_are_the_bits(image, tmp_path):
    tiny_network(tmp_path / "n.onnx")
    network = OnnxDetector(OnnxConfig(weights=tmp_path / "n.onnx"))
    bits, floats = network.detect(image), logit_features(network, image)
    assert np.array_equal(floats.keypoints_px, bits.keypoints_px)
    assert np.array_equal(np.packbits(floats.descriptors >= 0, axis=1), bits.descriptors)
    assert np.linalg.norm(floats.descriptors, axis=1) == pytest.approx(1.0)
    empty = logit_features(network, np.zeros((0, 0), np.uint8))
    assert (empty.keypoints_px.shape, empty.descriptors.shape) == ((0, 2), (0, 256))
