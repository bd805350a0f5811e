"""A released detector read back gives what it gave, and can be trained on."""

from pathlib import Path

import numpy as np
import pytest
import torch

pytest.importorskip("flwr", reason="needs fcslam[federated]")

from fcslam.errors import InputError
from fcslam.features.detector import BUNDLED_NETWORK, OnnxConfig, OnnxDetector, network_file
from fcslam.learning.export import export_onnx
from fcslam.learning.federated.initial_weights import (
    drawn_images,
    prepare_initial_weights,
    read_detector_weights,
    with_batch_statistics,
)
from fcslam.learning.federated.networks import network_to_weights, weights_to_network
from fcslam.learning.network import KeypointNetwork
from tests.features.networks import tiny_network


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


@pytest.mark.slow
@pytest.mark.parametrize("encoder", ["light", "vgg"])
def test_it_is_the_same_function(encoder, tmp_path):
    network = lived_in(encoder)
    export_onnx(network, tmp_path / "detector.onnx")
    weights = read_detector_weights(tmp_path / "detector.onnx", encoder)
    pictures = np.random.default_rng(1).integers(0, 256, (2, 64, 96), np.uint8)
    images = torch.from_numpy(pictures)[:, None].float() / 255.0
    for read in (weights, with_batch_statistics(weights, encoder, list(pictures))):
        with torch.inference_mode():
            for ours, theirs in zip(weights_to_network(read, encoder)(images), network(images), strict=True):
                assert torch.allclose(ours, theirs, rtol=1e-3, atol=1e-4 * float(theirs.abs().max()))


@pytest.mark.parametrize(("encoder", "name"), [("light", None), ("vgg", Path("vgg"))])
def test_the_networks_that_come_with_fcslam_can_be_trained_on(encoder, name):
    read = weights_to_network(read_detector_weights(network_file(name), encoder), encoder)
    picture = np.random.default_rng(0).integers(0, 256, (64, 96), np.uint8)
    scores, logits = OnnxDetector(OnnxConfig(weights=name)).infer(picture)
    with torch.inference_mode():
        maps = read(torch.from_numpy(picture)[None, None].float() / 255.0)
        assert np.allclose(read.scores(maps)[0], scores, atol=1e-4)
    assert np.allclose(maps.code_logits[0], logits, rtol=1e-3, atol=1e-3)


@pytest.mark.slow
def test_what_no_normalisation_had_become_is_another_function_as_soon_as_it_is_trained():
    """Normalised again, the network stays the same; the more similar the images are, the smaller is the difference."""
    released = read_detector_weights(BUNDLED_NETWORK, "light")
    images = [image[:120, :120] for image in drawn_images()]
    batch = torch.from_numpy(np.stack(images[:16]))[:, None].float() / 255.0
    given, alike = (with_batch_statistics(released, "light", part) for part in (images[:16], images[16:]))
    with torch.inference_mode():
        expected = weights_to_network(released, "light")(batch)
        networks = [weights_to_network(weights, "light") for weights in (given, alike, released)]
        assert torch.allclose(networks[0](batch).code_logits, expected.code_logits, rtol=1e-3, atol=1e-3)
        assert torch.allclose(networks[0](batch).point_logits, expected.point_logits, rtol=1e-3, atol=1e-3)
        bits = [network.train()(batch).code_logits > 0.0 for network in networks]
    same = [float((each == (expected.code_logits > 0.0)).float().mean()) for each in bits]
    assert same[0] > 0.99
    assert same[1] > 0.85
    assert same[2] < 0.8


def test_a_channel_that_says_the_same_everywhere_is_normalised_as_well():
    network = lived_in("light")
    network.body.joint[0][0].weight.data[3] = 0.0
    weights = network_to_weights(network)
    given = with_batch_statistics(weights, "light", [np.random.default_rng(1).integers(0, 256, (64, 96), np.uint8)])
    images = torch.rand(2, 1, 64, 96, generator=torch.Generator().manual_seed(1))
    with torch.inference_mode():
        ours, theirs = (weights_to_network(each, "light")(images).code_logits for each in (given, weights))
    assert torch.allclose(ours, theirs, rtol=1e-3, atol=1e-4 * float(theirs.abs().max()))


@pytest.mark.slow
def test_a_fleet_goes_on_from_the_start_it_had_whatever_public_images_there_are_now(tmp_path):
    export_onnx(lived_in("light"), tmp_path / "detector.onnx")
    pictures = np.random.default_rng(1).integers(0, 256, (2, 96, 96), np.uint8)

    def first(public):
        return prepare_initial_weights(tmp_path / "detector.onnx", tmp_path, "light", public)

    begun, read = first([pictures[0]]), read_detector_weights(tmp_path / "detector.onnx", "light")
    assert any((begun[name] != read[name]).any() for name in begun)
    again = first([pictures[1]])
    assert all(np.array_equal(begun[name], again[name]) for name in begun)
    (tmp_path / "start.state").write_bytes(b"torn")
    assert any((begun[name] != array).any() for name, array in first([pictures[1]]).items())


@pytest.mark.slow
def test_another_network_is_refused_by_name(tmp_path):
    export_onnx(lived_in("light"), tmp_path / "light.onnx")
    (tmp_path / "text.onnx").write_text("hello")
    tiny_network(tmp_path / "tiny.onnx")
    for name, encoder in (("light", "vgg"), ("text", "light"), ("tiny", "light")):
        with pytest.raises(InputError, match=name):
            read_detector_weights(tmp_path / f"{name}.onnx", encoder)
