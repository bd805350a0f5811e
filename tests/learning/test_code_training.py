"""Training of the codes alone: what changes, what stays, and that it goes on where it was interrupted."""

import numpy as np
import pytest
import torch

from fcslam.errors import InputError
from fcslam.features.detector import BUNDLED_NETWORK
from fcslam.learning.code_batches import RevisitExamples, RevisitPair
from fcslam.learning.code_training import CodeInputs, train_codes
from fcslam.learning.federated.initial_weights import read_detector_weights
from fcslam.learning.federated.networks import weights_to_network
from fcslam.learning.network import KeypointNetwork, layer_names, network_from_state, sample_codes
from fcslam.learning.settings import TrainingSettings
from fcslam.learning.training_loop import RAMP_STEPS, LocalTrainingPlan
from tests.learning.textures import textured

pytestmark = pytest.mark.slow

CPU = torch.device("cpu")
SMALL = TrainingSettings(steps=40)
SIZE, SHIFT = 96, 8
PICTURE = textured(1)
POINTS = np.random.default_rng(2).uniform(16, SIZE - 16, (40, 2)).astype(np.float32)
NOWHERE = np.full((40, 3), np.nan)
DARK = (0.4 * PICTURE[:SIZE, SHIFT : SHIFT + SIZE]).astype(np.uint8)
PAIR = RevisitPair((0, 1), (POINTS, POINTS - np.array([SHIFT, 0], np.float32)), NOWHERE)
OWN = RevisitExamples([PICTURE[:SIZE, :SIZE], DARK], [PAIR])


@pytest.fixture(scope="module", params=["light", "vgg"])
def encoder(request):
    return request.param


@pytest.fixture(scope="module")
def start(encoder):
    torch.manual_seed(1)
    return KeypointNetwork(encoder).state_dict()


@pytest.fixture(scope="module")
def light():
    """The bundled network, which a fleet starts from."""
    return weights_to_network(read_detector_weights(BUNDLED_NETWORK, "light"), "light").state_dict()


def trained(state, plan, encoder="light", revisits=OWN, inputs=None, before=None):
    network = network_from_state(encoder, state if before is None else before)
    return train_codes(state, revisits, inputs or CodeInputs(), plan, network)


def codes(state, image, points):
    network = network_from_state("light", state)
    with torch.inference_mode():
        maps = network(torch.from_numpy(image)[None, None].float() / 255.0)
    return sample_codes(maps.code_logits, torch.from_numpy(points)[None])[0].numpy() >= 0


def test_only_the_layers_of_the_codes_change(encoder, start):
    settings = SMALL.model_copy(update={"encoder": encoder})
    network, _, _ = trained(start, LocalTrainingPlan(settings, 0, 3), encoder)
    changed = {name for name, tensor in network.state_dict().items() if not torch.equal(start[name], tensor)}
    assert changed
    assert changed <= layer_names(network, network.body.code_layers)
    assert not any("running" in name for name in changed)
    before = network_from_state(encoder, start)
    image = torch.rand(1, 1, 64, 64, generator=torch.Generator().manual_seed(1))
    with torch.inference_mode():
        assert not torch.allclose(before(image).code_logits, network(image).code_logits, atol=1e-5)
        if encoder == "vgg":
            assert torch.allclose(before(image).point_logits, network(image).point_logits, atol=1e-5)


def test_whole_images_give_what_their_inputs_give(encoder, start):
    network = network_from_state(encoder, start)
    image = torch.rand(2, 1, 64, 48, generator=torch.Generator().manual_seed(1))
    with torch.inference_mode():
        code_logits, _ = network.body.describe(network.body.code_inputs(image))
        assert torch.equal(code_logits, network(image).code_logits)


def test_training_brings_the_codes_of_a_point_together(light):
    def distance(state):
        first, second = (codes(state, image, points) for image, points in zip(OWN.images, PAIR.points, strict=True))
        return float(np.mean(first != second))

    done, losses, _ = trained(light, LocalTrainingPlan(SMALL, 0, 20))
    assert {"contrastive", "balance", "keypoints", "rehearsal"} == losses.keys()
    assert distance(done.state_dict()) < 0.8 * distance(light)


def test_codes_of_pictures_that_the_robot_does_not_see_are_those_of_the_network_before(light):
    elsewhere = textured(9)[:SIZE, :SIZE]
    noise = torch.Generator().manual_seed(7)
    layer = light["body.code_head.1.weight"]
    noisy = light | {"body.code_head.1.weight": layer + 2.0 * layer.std() * torch.randn(layer.shape, generator=noise)}

    def likeness(before):
        state = trained(light, LocalTrainingPlan(SMALL, 0, 20), before=before)[0].state_dict()
        return np.mean(codes(state, elsewhere, POINTS) == codes(noisy, elsewhere, POINTS))

    assert likeness(noisy) > likeness(light) + 0.04


def test_rounds_continue_with_their_moments_and_from_where_the_first_began(light):
    inputs = CodeInputs()
    whole, _, _ = trained(light, LocalTrainingPlan(SMALL, 0, RAMP_STEPS + 1), inputs=inputs)
    first, _, moments = trained(light, LocalTrainingPlan(SMALL, 0, RAMP_STEPS), inputs=inputs)
    after = LocalTrainingPlan(SMALL, RAMP_STEPS, 1, optimizer_state=moments)
    second, _, _ = trained(first.state_dict(), after, inputs=inputs, before=light)
    expected = whole.state_dict()
    assert all(torch.equal(tensor, expected[name]) for name, tensor in second.state_dict().items())


def test_inputs_are_computed_again_only_if_the_layers_before_changed(light):
    inputs = CodeInputs()
    network = network_from_state("light", light)
    first = inputs.of(network, OWN.images, 1, CPU)
    with torch.no_grad():
        network.body.code_head[-1].bias += 1.0
    assert inputs.of(network, OWN.images, 1, CPU) is first
    with torch.no_grad():
        network.body.to_half[0][0].weight += 0.1
    assert not torch.equal(inputs.of(network, OWN.images, 1, CPU), first)


def test_a_robot_that_saw_nothing_again_is_told_so(light):
    with pytest.raises(InputError, match="no place was"):
        trained(light, LocalTrainingPlan(SMALL, 0, 1), revisits=RevisitExamples(OWN.images))
