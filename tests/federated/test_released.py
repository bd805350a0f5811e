"""A released detector read back gives what it gave, and can be trained on."""

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="needs fcslam[federated]")
pytest.importorskip("flwr", reason="needs fcslam[federated]")

from features.networks import tiny_network  # noqa: E402

from fcslam.errors import TrainingError  # noqa: E402
from fcslam.features.detector import SHIPPED_NETWORK, OnnxConfig, OnnxDetector  # noqa: E402
from fcslam.federated.network import network_of  # noqa: E402
from fcslam.federated.released import normalised  # noqa: E402
from fcslam.federated.start import read_weights  # noqa: E402
from fcslam.federated.weights import trained_names  # noqa: E402
from fcslam.learning.export import export, quantise  # noqa: E402
from fcslam.learning.network import KeypointNetwork  # noqa: E402
from fcslam.learning.stages import Shapes  # noqa: E402


def lived_in(encoder):
    """A network whose normalisations are not those it was born with."""
    torch.manual_seed(5)
    network = KeypointNetwork(encoder)
    for module in network.modules():
        if isinstance(module, torch.nn.BatchNorm2d):
            for tensor in (module.weight, module.running_var):
                tensor.data.uniform_(0.5, 2.0)
            for tensor in (module.bias, module.running_mean):
                tensor.data.uniform_(-0.5, 0.5)
    for parameter in network.parameters():
        if not parameter.any():  # layers that begin as no change
            parameter.data.uniform_(-0.1, 0.1)
    return network.eval()


@pytest.mark.parametrize("encoder", ["light", "vgg"])
def test_it_is_the_same_function(encoder, tmp_path):
    network = lived_in(encoder)
    export(network, tmp_path / "detector.onnx")
    weights = read_weights(tmp_path / "detector.onnx", encoder)
    pictures = np.random.default_rng(1).integers(0, 256, (2, 64, 96), np.uint8)
    images = torch.from_numpy(pictures)[:, None].float() / 255.0
    for read in (weights, normalised(weights, encoder, list(pictures))):
        with torch.inference_mode():
            for ours, theirs in zip(network_of(read, encoder)(images), network(images), strict=True):
                assert torch.allclose(ours, theirs, rtol=1e-3, atol=1e-4 * float(theirs.abs().max()))


def test_the_network_that_comes_with_fcslam_can_be_trained_on():
    read = network_of(read_weights(SHIPPED_NETWORK, "light"), "light")
    picture = np.random.default_rng(0).integers(0, 256, (64, 96), np.uint8)
    scores, logits = OnnxDetector(OnnxConfig()).infer(picture)
    with torch.inference_mode():
        maps = read(torch.from_numpy(picture)[None, None].float() / 255.0)
        assert np.allclose(read.scores(maps)[0], scores, atol=1e-4)
    assert np.allclose(maps.code_logits[0], logits, rtol=1e-3, atol=1e-3)


def test_its_normalisations_begin_as_none(tmp_path):
    """So everything that training moves is there, and statistics can be frozen."""
    export(lived_in("light"), tmp_path / "detector.onnx")
    weights = read_weights(tmp_path / "detector.onnx", "light")
    statistics = set(weights) - set(trained_names(weights, frozen_statistics=True))
    assert statistics
    for name in statistics:
        assert np.allclose(weights[name], 0.0 if name.endswith("mean") else 1.0, atol=2e-5)


def test_normalised_it_is_the_same_function_and_stays_so_when_batches_normalise_it():
    """What no normalisation had become is another function as soon as it is trained."""
    released = read_weights(SHIPPED_NETWORK, "light")
    shapes = [example.image for example in Shapes(5, 8)[:]]
    batch = torch.from_numpy(np.stack(shapes))[:, None].float() / 255.0
    given = normalised(released, "light", shapes)
    with torch.inference_mode():
        expected = network_of(released, "light")(batch)
        networks = [network_of(weights, "light") for weights in (given, released)]
        assert torch.allclose(networks[0](batch).code_logits, expected.code_logits, rtol=1e-3, atol=1e-3)
        assert torch.allclose(networks[0](batch).point_logits, expected.point_logits, rtol=1e-3, atol=1e-3)
        bits = [network.train()(batch).code_logits > 0.0 for network in networks]
    same = [float((each == (expected.code_logits > 0.0)).float().mean()) for each in bits]
    assert same[0] > 0.9
    assert same[1] < 0.75


def test_normalised_weights_do_not_hang_on_the_last_digit_of_an_image():
    released = read_weights(SHIPPED_NETWORK, "light")
    shapes = [example.image for example in Shapes(5, 3)[:]]
    again = [image.copy() for image in shapes]
    again[0][10, 10] ^= 1
    first, other = (normalised(released, "light", images) for images in (shapes, again))
    assert all(np.array_equal(first[name], other[name]) for name in released)


def test_another_network_is_refused_by_name(tmp_path):
    export(lived_in("light"), tmp_path / "light.onnx")
    quantise(tmp_path / "light.onnx", tmp_path / "int8.onnx", [np.full((64, 64), 128, np.uint8)])
    (tmp_path / "text.onnx").write_text("hello")
    tiny_network(tmp_path / "tiny.onnx")
    for name, encoder in (("light", "vgg"), ("int8", "light"), ("text", "light"), ("tiny", "light")):
        with pytest.raises(TrainingError, match=name):
            read_weights(tmp_path / f"{name}.onnx", encoder)
