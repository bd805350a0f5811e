"""Training on places that were seen again: batches, the objective, and that training follows it."""

import numpy as np
import pytest

from tests.learning.textures import textured

torch = pytest.importorskip("torch", reason="needs fcslam[train]")

from fcslam.learning.labels import Labels  # noqa: E402
from fcslam.learning.local_training import LocalTrainingPlan, local_training  # noqa: E402
from fcslam.learning.network import KeypointNetwork, Maps, sample_codes  # noqa: E402
from fcslam.learning.objective import revisit_objective  # noqa: E402
from fcslam.learning.pairs import TrainingExample  # noqa: E402
from fcslam.learning.revisit_batches import (  # noqa: E402
    MOST_POINTS,
    VIEWS,
    RevisitExamples,
    RevisitPair,
    TaughtImage,
    draw_revisits,
)
from fcslam.learning.settings import LossSettings, TrainingSettings  # noqa: E402

SIZE = 96
RNG = np.random.default_rng(2)
POINTS = RNG.uniform(8, SIZE - 8, (40, 2)).astype(np.float32)
IMAGES = [textured(seed)[:SIZE, :SIZE] for seed in range(3)]
PAIR = RevisitPair((IMAGES[0], IMAGES[1]), (POINTS, POINTS[::-1].copy()))
TAUGHT = TaughtImage(IMAGES[2], POINTS, RNG.integers(0, 256, (40, 32)).astype(np.uint8))


@pytest.mark.parametrize(
    ("examples", "pairs", "taught"),
    [
        (RevisitExamples([PAIR]), 2, 0),
        (RevisitExamples(taught=[TAUGHT]), 0, 4),
        (RevisitExamples([PAIR], [TAUGHT]), 1, 2),
    ],
)
def test_a_batch_holds_views_and_fixed_codes(examples, pairs, taught):
    batch = draw_revisits(examples, 1, 5)
    count = pairs + taught
    assert batch.images.shape == (VIEWS, 1, SIZE, SIZE)
    assert batch.points.shape == (2 * count, MOST_POINTS, 2)
    assert batch.codes.shape == (taught, MOST_POINTS, 256)
    assert batch.valid.sum(1).tolist() == [40] * count
    firsts, seconds = batch.points.chunk(2)
    for k in range(pairs):  # the points of a pair stay together
        both = {(*a, *b) for a, b in zip(firsts[k, :40].tolist(), seconds[k, :40].tolist(), strict=True)}
        assert both == {(*a, *b) for a, b in zip(*(each.tolist() for each in PAIR.points), strict=True)}
    for k in range(taught):
        assert torch.equal(firsts[pairs + k], seconds[pairs + k])
        order = [POINTS.tolist().index(point) for point in firsts[pairs + k, :40].tolist()]
        expected = 2.0 * np.unpackbits(TAUGHT.codes, axis=1)[order] - 1.0
        assert np.array_equal(batch.codes[k, :40].numpy(), expected)
    again = draw_revisits(examples, 1, 5)
    assert all(torch.equal(getattr(batch, name), getattr(again, name)) for name in ("images", "points", "codes"))


def test_examples_are_false_only_without_any():
    assert not RevisitExamples()
    assert RevisitExamples([PAIR])
    assert RevisitExamples(taught=[TAUGHT])


def objective(code_logits, batch):
    maps = Maps(torch.zeros(len(code_logits), SIZE, SIZE), code_logits)
    return revisit_objective(maps, batch, LossSettings(), 1.0)


def test_codes_that_agree_cost_least_and_equal_codes_of_all_points_do_not_pay():
    batch = draw_revisits(RevisitExamples(taught=[TAUGHT]), 1, 5)
    cells = SIZE // 8
    columns = torch.randn(4, 256, cells, cells, generator=torch.Generator().manual_seed(1))
    logits = sample_codes(columns, batch.points[:4])
    agreeing = torch.where(logits >= 0, 1.0, -1.0) * batch.valid[..., None]
    right = batch.codes
    batch = type(batch)(batch.images, batch.points, batch.valid, agreeing)
    good, _ = objective(4.0 * columns, batch)
    other, _ = objective(4.0 * columns, type(batch)(batch.images, batch.points, batch.valid, right))
    collapsed, parts = objective(torch.full_like(columns, 4.0), batch)
    assert good < 0.5 * other
    assert collapsed > 2.0 * good
    assert parts["revisit_balance"] > 0.9
    assert parts["revisit_triplet"] > 1.0


@pytest.mark.slow
def test_training_brings_codes_towards_the_taught_ones():
    torch.manual_seed(1)
    start = KeypointNetwork("light").state_dict()
    labels = Labels(POINTS, np.linspace(1, 0.1, len(POINTS), dtype=np.float32))
    plain = [TrainingExample(image, labels) for image in IMAGES]
    settings = TrainingSettings(steps=60, pairs=1, side_px=64, points=32)

    def distance(state):
        network = KeypointNetwork("light")
        network.load_state_dict(state)
        network.eval()
        with torch.inference_mode():
            logits = sample_codes(
                network(torch.from_numpy(IMAGES[2])[None, None].float() / 255.0).code_logits,
                torch.from_numpy(POINTS)[None],
            )
        bits = np.unpackbits(TAUGHT.codes, axis=1)
        return float(np.mean((logits[0].numpy() >= 0) != bits))

    examples = RevisitExamples([PAIR], [TAUGHT])
    done = local_training(start, plain, settings, LocalTrainingPlan(0, 60), torch.device("cpu"), revisits=examples)
    assert {"revisit_triplet", "revisit_contrastive", "revisit_balance"} <= done.losses.keys()
    without = local_training(start, plain, settings, LocalTrainingPlan(0, 60), torch.device("cpu"))
    assert distance(done.network.state_dict()) < distance(without.network.state_dict()) - 0.1
