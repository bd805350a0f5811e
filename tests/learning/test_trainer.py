"""The training loop: it learns, resumes as if nothing had happened, keeps what it has, and sounds its alarms."""

import numpy as np
import pytest
import torch

from fcslam.errors import InputError
from fcslam.learning.labels import Teacher, fuse_keypoints, harris, peaks
from fcslam.learning.network import KeypointNetwork
from fcslam.learning.objective import negatives, shift_grid, teacher_bits
from fcslam.learning.pairs import TrainingExample
from fcslam.learning.settings import TrainingSettings
from fcslam.learning.trainer import CHECKPOINT_FILE, ExecutionOptions, TrainingRun
from fcslam.learning.training_loop import learning_rate
from fcslam.learning.validation import collapse_warnings, validate, validation_pairs
from tests.learning.textures import textured

SMALL = TrainingSettings(steps=6, pairs=1, side_px=64)
pytestmark = pytest.mark.usefixtures("brief_validation")
PACE = ExecutionOptions(validate_every=100, checkpoint_every_s=0.0, log_every=1)


@pytest.fixture(scope="module")
def examples():
    made = []
    for seed in range(3):
        image = textured(seed)
        points = peaks(harris(image), 4, 200)
        descriptors = np.random.default_rng(seed).normal(size=(len(points), 16)).astype(np.float16)
        made.append(TrainingExample(image, fuse_keypoints(points, points), Teacher(points, descriptors)))
    return made


def weights(network):
    return torch.cat([value.flatten().double() for value in network.state_dict().values()])


@pytest.mark.slow
def test_a_run_learns(examples, tmp_path):
    longer = SMALL.model_copy(update={"steps": 40, "pairs": 1})
    figures = []
    TrainingRun(longer, tmp_path, PACE).train(
        examples, examples[:1], on_progress=lambda _step, _steps, metrics, _warnings: figures.append(metrics)
    )
    first, last = ([np.mean([row[name] for row in part]) for name in ("detector", "contrastive")]
                   for part in (figures[:3], figures[-3:]))  # fmt: skip
    assert (np.array(last) < 0.85 * np.array(first)).all()


@pytest.mark.slow
def test_an_interrupted_run_ends_as_if_it_had_not_been(examples, tmp_path):
    bits = teacher_bits(torch.from_numpy(examples[0].teacher.descriptors.astype(np.float32)), 1)
    whole = TrainingRun(SMALL, tmp_path / "whole", PACE)
    (tmp_path / "whole").mkdir()
    (tmp_path / "torn").mkdir()

    def stop(step, *_):
        if step == 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        TrainingRun(SMALL, tmp_path / "torn", PACE).train(examples, examples[:1], bits, stop)
    resumed = TrainingRun(SMALL, tmp_path / "torn", PACE)
    steps = []
    torn = resumed.train(examples, examples[:1], bits, lambda step, *_: steps.append(step))
    assert steps == [4, 5, 6]
    assert torch.equal(weights(whole.train(examples, examples[:1], bits)), weights(torn))


@pytest.mark.parametrize("content", [b"", b"no checkpoint", b"PK\x03\x04"])
def test_a_foreign_checkpoint_is_said(examples, tmp_path, content):
    (tmp_path / CHECKPOINT_FILE).write_bytes(content)
    with pytest.raises(InputError, match=r"checkpoint\.state: is damaged"):
        TrainingRun(SMALL, tmp_path, PACE).train(examples, examples[:1])


@pytest.mark.slow
def test_a_checkpoint_of_other_settings_is_refused_but_more_steps_are_not(examples, tmp_path):
    TrainingRun(SMALL, tmp_path, PACE).train(examples, examples[:1])
    with pytest.raises(InputError, match="other settings"):
        TrainingRun(SMALL.model_copy(update={"seed": 5}), tmp_path, PACE).train(examples, examples[:1])
    more = TrainingRun(SMALL.model_copy(update={"steps": 7}), tmp_path, PACE)
    more.train(examples, examples[:1])
    assert more.step == 7


@pytest.mark.slow
def test_collapsed_codes_sound_the_alarm(examples):
    network = KeypointNetwork("light").eval()
    head = network.body.code_head[-1]
    head.weight.data.zero_()
    head.bias.data.fill_(1.0)
    figures = validate(network, validation_pairs(examples), torch.device("cpu"))
    assert figures["code_spread_bits"] == 0.0
    assert figures["bit_bias"] == 0.5
    assert len(collapse_warnings(figures)) == 2
    assert collapse_warnings({"code_spread_bits": 120.0, "bit_bias": 0.05}) == []


def test_a_perfect_detector_of_unmoved_pictures_scores_one():
    """The same view twice: everything is found again, everything matches."""
    image = textured(4)
    points = peaks(harris(image), 4, 100)
    (pair,) = validation_pairs([TrainingExample(image, fuse_keypoints(points, points))])
    same = type(pair)(
        (pair.views[0], pair.views[0]), pair.valid, pair.teacher_valid, pair.teacher_descriptors, np.eye(3)
    )
    figures = validate(KeypointNetwork("light").eval(), [same], torch.device("cpu"))
    assert figures["repeatability"] == 1.0
    assert figures["mma_3px"] > 0.95


def test_the_rate_rises_stays_and_falls():
    settings = TrainingSettings(steps=10_000, learning_rate=1e-3)
    rates = [learning_rate(settings, step) for step in range(10_000)]
    assert rates[0] == pytest.approx(1e-5)
    assert set(rates[1000:6900]) == {1e-3}
    assert rates[-1] == pytest.approx(1e-5, rel=0.1)


def test_neighbours_in_either_view_are_no_negatives():
    first = [[0.0, 0.0], [3.0, 0.0], [50.0, 0.0], [90.0, 0.0]]
    second = [[0.0, 0.0], [30.0, 0.0], [60.0, 0.0], [63.0, 0.0]]
    allowed = negatives(torch.tensor([first, second]), torch.ones(1, 4, dtype=torch.bool))[0]
    close = {(0, 1), (2, 3)}
    assert [[bool(allowed[i, j]) for j in range(4)] for i in range(4)] == [
        [i != j and (min(i, j), max(i, j)) not in close for j in range(4)] for i in range(4)
    ]
    only_two = torch.tensor([[True, True, False, False]])
    assert not negatives(torch.tensor([first, second]), only_two).any()


def test_a_shifted_grid_keeps_whole_cells():
    (cut,) = shift_grid((torch.arange(24 * 16).reshape(1, 24, 16),), (3, 5))
    assert cut.shape == (1, 16, 8)
    assert cut[0, 0, 0].item() == 3 * 16 + 5


def test_teacher_bits_are_balanced_and_keep_angles():
    descriptors = torch.nn.functional.normalize(
        torch.randn(2000, 64, generator=torch.Generator().manual_seed(0)), dim=1
    )
    bits = teacher_bits(descriptors, 3).probabilities(descriptors) > 0.5
    assert (bits.float().mean(0) - 0.5).abs().max() < 0.06
    angles = torch.arccos((descriptors[:50] @ descriptors[:50].T).clamp(-1, 1))
    hamming = torch.cdist(bits[:50].float(), bits[:50].float()).square()
    upper = torch.triu(torch.ones(50, 50), 1) > 0
    assert torch.corrcoef(torch.stack((angles[upper], hamming[upper])))[0, 1] > 0.8
