"""Networks as detectors: the contract, images of any size, and what breaks the contract."""

import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from fcslam.errors import FeatureError
from fcslam.features.classical import Orb, make_detector
from fcslam.features.detector import BUNDLED_NETWORK, OnnxConfig, OnnxDetector
from fcslam.features.detector_kinds import DetectorKind
from tests.features.networks import tiny_network

pytest.importorskip("onnxruntime")


def image_with_dots(shape, dots):
    image = np.zeros(shape, np.uint8)
    for x, y, level in dots:
        image[y, x] = level
    return image


@pytest.fixture
def weights(tmp_path):
    path = tmp_path / "tiny.onnx"
    tiny_network(path)
    return path


def test_keypoints_are_where_the_probability_peaks(weights):
    detector = OnnxDetector(OnnxConfig(weights=weights))
    found = detector.detect(image_with_dots((50, 61), [(10, 20, 200), (58, 48, 255), (30, 5, 100)]))
    assert detector.version == "tiny-1"
    assert found.keypoints_px.tolist() == [[58, 48], [10, 20], [30, 5]]
    assert np.allclose(found.scores, (np.array([255, 200, 100]) / 255) ** 2, atol=1e-6)
    assert found.descriptors.shape == (3, 32)


def test_bits_are_the_signs_of_the_logits_at_a_cells_centre(tmp_path):
    kernel = tiny_network(tmp_path / "n.onnx")
    image = np.zeros((16, 24), np.uint8)
    image[3:5, 11:13] = 250  # a flat top around (11.5, 3.5), the centre of cell (0, 1)
    found = OnnxDetector(OnnxConfig(weights=tmp_path / "n.onnx", nms_px=4)).detect(image)
    assert found.keypoints_px.tolist() == [[11.5, 3.5]]
    cell = image[:8, 8:16].astype(np.float32) / 255
    expected = np.einsum("bchw,hw->b", kernel, cell) >= 0
    assert np.array_equal(np.unpackbits(found.descriptors[0]), expected)


@pytest.mark.parametrize("shape", [(1, 1), (3, 5), (7, 300), (8, 8), (240, 320), (241, 317)])
def test_images_of_any_size_give_keypoints_inside(weights, shape):
    image = np.random.default_rng(1).integers(0, 256, shape, np.uint8)
    found = OnnxDetector(OnnxConfig(weights=weights)).detect(image)
    assert len(found.scores) > 0
    assert np.all((found.keypoints_px > -0.51) & (found.keypoints_px < np.array(shape[::-1]) - 0.49))


def test_nothing_to_see_is_an_empty_well_shaped_result(weights):
    for shape in ((240, 320), (0, 0)):
        found = OnnxDetector(OnnxConfig(weights=weights)).detect(np.zeros(shape, np.uint8))
        assert (found.keypoints_px.shape, found.scores.shape, found.descriptors.shape) == ((0, 2), (0,), (0, 32))


def test_settings_bound_what_is_kept(weights):
    image = np.random.default_rng(1).integers(0, 256, (120, 160), np.uint8)
    found = OnnxDetector(OnnxConfig(weights=weights, most_features=50, least_score=0.5)).detect(image)
    assert len(found.scores) == 50
    assert np.all(np.diff(found.scores) <= 0)
    assert np.all(found.scores > 0.5)


def test_keypoints_of_all_scales_are_in_pixels_of_the_image(weights):
    """A flat square of 12 x 12 px is centred at (37.5, 21.5); half the size has the same centre."""
    image = np.zeros((64, 96), np.uint8)
    image[16:28, 32:44] = 200
    image[20:24, 36:40] = 255
    for scales in ((0.5,), (1.0, 0.5)):
        found = OnnxDetector(OnnxConfig(weights=weights, scales=scales, nms_px=16)).detect(image)
        centred = np.abs(found.keypoints_px - (37.5, 21.5)).max(axis=1) <= 1.0
        assert centred.sum() >= len(scales)
        assert (np.diff(found.scores) <= 0).all()
    assert found.descriptors.shape == (len(found.scores), 32)


def test_one_scale_of_a_pyramid_is_the_image_itself(weights):
    image = np.random.default_rng(1).integers(0, 256, (120, 160), np.uint8)
    plain = OnnxDetector(OnnxConfig(weights=weights, scales=(1.0,))).detect(image)
    several = OnnxDetector(OnnxConfig(weights=weights, scales=(1.0, 0.25), most_features=2000)).detect(image)
    ranks = {
        tuple(point): code.tobytes() for point, code in zip(several.keypoints_px, several.descriptors, strict=True)
    }
    for point, code in zip(plain.keypoints_px, plain.descriptors, strict=True):
        assert ranks[tuple(point)] == code.tobytes()


@pytest.mark.parametrize(
    ("broken", "message"),
    [
        ({"form": "2"}, "its format is 2, not 1"),
        ({"form": None}, "its format is none"),
        ({"version": None}, "is not a detector version"),
        ({"version": "a b"}, "'a b' is not a detector version"),
        ({"bits": 128}, r"\(128, 3, 5\) logits"),
        ({"stride": 4}, r"\(256, 6, 10\) logits"),
        ({"outputs": ("heat", "codes")}, "does not run"),
    ],
)
def test_networks_that_break_the_contract_are_refused(tmp_path, broken, message):
    tiny_network(tmp_path / "n.onnx", **broken)
    with pytest.raises(FeatureError, match=message):
        OnnxDetector(OnnxConfig(weights=tmp_path / "n.onnx"))


def test_foreign_and_missing_files_are_refused(tmp_path):
    (tmp_path / "n.onnx").write_bytes(b"no network at all")
    with pytest.raises(FeatureError, match="not an ONNX network"):
        OnnxDetector(OnnxConfig(weights=tmp_path / "n.onnx"))
    with pytest.raises(FeatureError, match="cannot read the network weights"):
        OnnxDetector(OnnxConfig(weights=tmp_path / "missing.onnx"))


def test_the_bundled_network_is_the_default_and_has_the_version_that_is_named(tmp_path):
    shutil.copy(BUNDLED_NETWORK, tmp_path / "copy.onnx")
    named = OnnxDetector(OnnxConfig())
    assert named.version == OnnxDetector(OnnxConfig(weights=tmp_path / "copy.onnx")).version
    assert len(named.detect(np.kron(np.eye(8, dtype=np.uint8), np.full((16, 16), 255, np.uint8))).scores)


def test_the_bundled_network_is_loaded_for_the_first_image():
    program = (
        "import sys, fcslam.robot.views; from fcslam.features.detector import OnnxConfig, OnnxDetector; "
        "assert OnnxDetector(OnnxConfig()).version; assert 'onnxruntime' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", program], check=True)


def test_a_bare_name_is_a_bundled_network_and_finds_corners():
    image = np.kron(np.indices((8, 10)).sum(0) % 2, np.full((32, 32), 160)).astype(np.uint8) + 40
    detector = OnnxDetector(OnnxConfig(weights=Path("vgg"), most_features=40))
    found = detector.detect(image)
    assert detector.version.startswith("vgg-")
    # A corner of the board lies between four pixels, whole multiples of 32 less a half.
    off = (found.keypoints_px + 0.5 + 16.0) % 32.0 - 16.0
    assert len(off) == 40
    assert np.abs(off).max() < 4.0


def test_a_bare_name_of_no_bundled_network_is_a_file(tmp_path, weights, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert OnnxDetector(OnnxConfig(weights=Path(weights.name))).version == "tiny-1"


def test_the_kind_chooses(weights):
    onnx = OnnxConfig(weights=weights)
    assert make_detector(DetectorKind.ONNX, onnx).version == "tiny-1"
    assert isinstance(make_detector(DetectorKind.ORB, onnx), Orb)
