"""A leg of a run: it starts at the given weights, does not change frozen ones, and is pulled back as hard as the
settings say.
"""

from dataclasses import replace

import pytest

from tests.learning.textures import textured

torch = pytest.importorskip("torch", reason="needs fcslam[train]")

from fcslam.errors import TrainingError  # noqa: E402
from fcslam.learning.batches import draw_batch  # noqa: E402
from fcslam.learning.homographic_adaptation import harris, peaks  # noqa: E402
from fcslam.learning.labels import fuse_keypoints  # noqa: E402
from fcslam.learning.local_training import RAMP_STEPS, LocalTrainingPlan, local_training, network_from_state  # noqa: E402
from fcslam.learning.network import KeypointNetwork  # noqa: E402
from fcslam.learning.pairs import TrainingExample  # noqa: E402
from fcslam.learning.settings import TrainingSettings  # noqa: E402
from fcslam.learning.training_step import LegacyDetector, reduced_precision  # noqa: E402

pytestmark = pytest.mark.slow

SMALL = TrainingSettings(steps=40, pairs=1, side_px=64, points=32)
CPU = torch.device("cpu")


@pytest.fixture(scope="module")
def examples():
    images = [textured(seed) for seed in range(2)]
    points = [peaks(harris(image), 4, 200) for image in images]
    return [TrainingExample(image, fuse_keypoints(each, each)) for image, each in zip(images, points, strict=True)]


@pytest.fixture(scope="module")
def start():
    torch.manual_seed(1)
    return KeypointNetwork("light").state_dict()


def test_a_leg_does_its_steps_and_says_so(examples, start):
    done = []
    before = {name: tensor.clone() for name, tensor in start.items()}
    network, losses, _ = local_training(
        start, examples, LocalTrainingPlan(SMALL, first_step=5, steps=3, on_step=done.append)
    )
    assert done == [1, 2, 3]
    assert not network.training
    assert {"detector", "contrastive", "triplet"} <= losses.keys()
    assert all(torch.equal(start[name], before[name]) for name in start)
    assert any(not torch.equal(start[name], tensor) for name, tensor in network.state_dict().items())


def test_a_leg_learns(examples, start):
    longer = SMALL.model_copy(update={"pairs": 2})
    first = local_training(start, examples, LocalTrainingPlan(longer, first_step=0, steps=5)).losses
    network = local_training(start, examples, LocalTrainingPlan(longer, first_step=0, steps=30)).network
    last = local_training(network.state_dict(), examples, LocalTrainingPlan(longer, first_step=30, steps=5)).losses
    assert last["detector"] < 0.9 * first["detector"]


def test_two_legs_are_one_if_the_second_knows_the_first_ones_moments(examples, start):
    whole = local_training(start, examples, LocalTrainingPlan(SMALL, 0, RAMP_STEPS + 3))
    first = local_training(start, examples, LocalTrainingPlan(SMALL, 0, RAMP_STEPS))
    halfway = first.network.state_dict()
    second = local_training(
        halfway, examples, LocalTrainingPlan(SMALL, RAMP_STEPS, 3, optimizer_state=first.optimizer_state)
    )
    forgetful = local_training(halfway, examples, LocalTrainingPlan(SMALL, RAMP_STEPS, 3))
    expected = whole.network.state_dict()
    assert all(torch.equal(tensor, expected[name]) for name, tensor in second.network.state_dict().items())
    assert all(torch.equal(tensor, whole.optimizer_state[name]) for name, tensor in second.optimizer_state.items())
    assert any(not torch.equal(tensor, expected[name]) for name, tensor in forgetful.network.state_dict().items())


def test_moments_that_are_no_numbers_are_given_to_no_other_leg(examples, start, monkeypatch):
    def overflow(network, optimizer, *_, **__):
        for value in network.parameters():
            value.grad = torch.full_like(value, torch.inf)
        torch.nn.utils.clip_grad_norm_(network.parameters(), 1.0)
        optimizer.step()

    monkeypatch.setattr("fcslam.learning.local_training.descend", overflow)
    with pytest.raises(TrainingError, match="diverged in the last step"):
        local_training(start, examples, LocalTrainingPlan(SMALL, 0, 1))


def test_frozen_statistics_are_not_touched_while_their_scales_are_trained(examples, start):
    network = local_training(start, examples, LocalTrainingPlan(SMALL, 0, 2, frozen_statistics=True)).network
    changed = {name for name, tensor in network.state_dict().items() if not torch.equal(tensor, start[name])}
    assert not [name for name in changed if "running" in name]
    norms = {name.removesuffix("running_var") for name in start if name.endswith("running_var")}
    assert all(f"{norm}weight" in changed for norm in norms)


def bits(network):
    image = torch.from_numpy(textured(5)).float()[None, None, :128, :128] / 255.0
    with torch.inference_mode():
        return network(image).code_logits >= 0


def test_a_network_is_not_pulled_away_from_its_own_codes(examples, start):
    network = network_from_state("light", start)
    batch = draw_batch(examples, SMALL, 0)
    with reduced_precision(CPU):
        maps = network(batch.images.contiguous(memory_format=torch.channels_last))
    logits = maps.code_logits.float().detach().requires_grad_()
    loss = LegacyDetector(1.0, network).loss(maps._replace(code_logits=logits), batch)
    loss.backward()
    assert logits.grad.abs().max() < 1e-6
    flipped = LegacyDetector(1.0, network).loss(maps._replace(code_logits=-logits), batch)
    assert flipped > loss
    nothing = replace(batch, valid=torch.zeros_like(batch.valid))
    assert LegacyDetector(1.0, network).loss(maps._replace(code_logits=-logits), nothing) == 0.0


def test_codes_are_kept_to_those_of_a_former_network(examples, start):
    torch.manual_seed(2)
    former = KeypointNetwork("light").state_dict()
    wanted = bits(network_from_state("light", former))

    def agreement(leg):
        network, losses, _ = local_training(start, examples, leg)
        assert ("former" in losses) is (leg.legacy is not None and leg.compatible > 0.0)
        return float((bits(network) == wanted).float().mean())

    free = agreement(LocalTrainingPlan(SMALL, 0, 15))
    assert agreement(LocalTrainingPlan(SMALL, 0, 15, legacy=former)) == free
    assert agreement(LocalTrainingPlan(SMALL, 0, 15, compatible=100.0, legacy=former)) > free + 0.1


def test_a_former_network_of_another_kind_is_refused(examples, start):
    with pytest.raises(TrainingError, match="not those of a light network"):
        local_training(start, examples, LocalTrainingPlan(SMALL, 0, 1, compatible=1.0, legacy={}))


def test_weights_that_make_training_diverge_are_said(examples, start):
    broken = start | {"body.code_head.1.bias": torch.full_like(start["body.code_head.1.bias"], torch.nan)}
    with pytest.raises(TrainingError, match="diverged at step 7"):
        local_training(broken, examples, LocalTrainingPlan(SMALL, 7, 1))
