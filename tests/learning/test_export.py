"""ONNX files: the same answers as torch at any size, and what is written in them."""

import numpy as np
import onnxruntime as runtime
import pytest
import torch

from fcslam.errors import InputError
from fcslam.learning.export import detector_version, export_onnx
from fcslam.learning.network import KeypointNetwork
from tests.learning.textures import textured


def network(encoder, seed=0):
    torch.manual_seed(seed)
    return KeypointNetwork(encoder).eval()


def answers(path, image):
    session = runtime.InferenceSession(str(path), providers=["CPUExecutionProvider"])
    return session.run(["scores", "logits"], {"image": image[None, None]}), session.get_modelmeta().custom_metadata_map


@pytest.mark.slow
@pytest.mark.parametrize("encoder", ["light", "vgg"])
def test_the_file_says_what_torch_says_at_any_size(encoder, tmp_path):
    net = network(encoder)
    export_onnx(net, tmp_path / "detector.onnx")
    for height, width in ((64, 96), (72, 88), (120, 136)):
        image = textured(1, width, height).astype(np.float32) / 255
        (scores, logits), metadata = answers(tmp_path / "detector.onnx", image)
        with torch.inference_mode():
            maps = net(torch.from_numpy(image)[None, None])
            expected = net.scores(maps).numpy()
        assert scores.shape == (1, height, width)
        assert logits.shape == (1, 256, height // 8, width // 8)
        assert scores == pytest.approx(expected, abs=1e-4)
        assert ((logits >= 0) != (maps.code_logits.numpy() >= 0)).mean() < 0.005
    assert metadata == {"fcslam_format": "1", "fcslam_version": detector_version(net)}
    assert sorted(file.name for file in tmp_path.iterdir()) == ["detector.onnx"]


def test_other_weights_have_another_version():
    first, second = network("light", 0), network("light", 1)
    assert detector_version(first) == detector_version(network("light", 0))
    assert detector_version(first) != detector_version(second)
    assert detector_version(first).startswith("light-")


@pytest.mark.slow
def test_a_place_that_cannot_be_written_is_said(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="cannot be written"):
        export_onnx(network("light"), tmp_path / "file" / "detector.onnx")
