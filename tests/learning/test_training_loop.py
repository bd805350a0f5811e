"""A leg of a run: it starts at the given weights and does the steps that it is asked for."""

import pytest
import torch

from fcslam.errors import InputError
from fcslam.learning.labels import fuse_keypoints, harris, peaks
from fcslam.learning.network import KeypointNetwork
from fcslam.learning.pairs import TrainingExample
from fcslam.learning.settings import TrainingSettings
from fcslam.learning.training_loop import RAMP_STEPS, LocalTrainingPlan, local_training
from tests.learning.textures import textured

pytestmark = pytest.mark.slow

SMALL = TrainingSettings(steps=40, pairs=1, side_px=64)


@pytest.fixture(scope="module")
def examples():
    images = [textured(seed) for seed in range(2)]
    points = [peaks(harris(image), 4, 200) for image in images]
    return [TrainingExample(image, fuse_keypoints(each, each)) for image, each in zip(images, points, strict=True)]


@pytest.fixture(scope="module")
def start():
    torch.manual_seed(1)
    return KeypointNetwork("light").state_dict()


def test_two_legs_are_one_if_the_second_knows_the_first_ones_moments(examples, start):
    whole, _, whole_state = local_training(start, examples, LocalTrainingPlan(SMALL, 0, RAMP_STEPS + 3))
    first, _, first_state = local_training(start, examples, LocalTrainingPlan(SMALL, 0, RAMP_STEPS))
    halfway = first.state_dict()
    second, _, second_state = local_training(
        halfway, examples, LocalTrainingPlan(SMALL, RAMP_STEPS, 3, optimizer_state=first_state)
    )
    forgetful, _, _ = local_training(halfway, examples, LocalTrainingPlan(SMALL, RAMP_STEPS, 3))
    expected = whole.state_dict()
    assert all(torch.equal(tensor, expected[name]) for name, tensor in second.state_dict().items())
    assert all(torch.equal(tensor, whole_state[name]) for name, tensor in second_state.items())
    assert any(not torch.equal(tensor, expected[name]) for name, tensor in forgetful.state_dict().items())


def test_weights_that_make_training_diverge_are_said(examples, start):
    broken = start | {"body.code_head.1.bias": torch.full_like(start["body.code_head.1.bias"], torch.nan)}
    with pytest.raises(InputError, match="diverged at step 7"):
        local_training(broken, examples, LocalTrainingPlan(SMALL, 7, 1))
