"""The losses against values computed by hand, and what they say of collapsed codes."""

import numpy as np
import pytest
import torch

from fcslam.learning import losses


def tensor(*rows):
    return torch.tensor(rows, dtype=torch.float64)


def everything_but_the_match(count):
    return ~torch.eye(count, dtype=torch.bool)[None]


def test_equation_1_is_one_from_zero_on():
    assert losses.binary_activation(tensor(-2.0, -1e-9, 0.0, 3.0)).tolist() == [0.0, 0.0, 1.0, 1.0]


def test_the_gradient_goes_straight_through():
    logits = tensor(-1.0, 0.0, 2.0).requires_grad_()
    losses.binary_activation(logits).sum().backward()
    assert logits.grad.numpy() == pytest.approx(0.5 / np.cosh([-1.0, 0.0, 2.0]) ** 2)


def test_equation_3_is_the_root_of_the_hamming_distance():
    a, b = tensor([1, 0, 1, 1], [0, 0, 0, 0]), tensor([1, 0, 0, 0], [0, 0, 0, 0])
    assert losses.code_distances(a, b, rounding=0.0).numpy() == pytest.approx(np.sqrt([[2, 3], [1, 0]]))


def test_equal_codes_have_a_finite_gradient():
    codes = tensor([1.0, 0.0, 1.0]).requires_grad_()
    losses.code_distances(codes, codes.detach(), rounding=0.01).sum().backward()
    assert torch.isfinite(codes.grad).all()


def test_equation_2_without_margin_by_hand():
    """d(c, p) on the diagonal; the hardest negative is the least of the rest of its row, and of its column."""
    distances = tensor([3.0, 2.0, 9.0], [5.0, 1.0, 4.0], [6.0, 7.0, 8.0])[None]
    valid = torch.ones(1, 3, dtype=torch.bool)
    loss = losses.triplet_loss(distances, everything_but_the_match(3), valid, margin=0.0)
    rows, columns = [3 - 2, 0, 8 - 6], [0, 0, 8 - 4]
    assert float(loss) == pytest.approx(np.mean([rows, columns]))


def test_points_that_are_not_valid_do_not_count():
    distances = tensor([3.0, 2.0, 0.0], [5.0, 1.0, 0.0], [0.0, 0.0, 99.0])[None]
    valid = torch.tensor([[True, True, False]])
    candidates = everything_but_the_match(3) & valid[:, :, None] & valid[:, None, :]
    assert float(losses.triplet_loss(distances, candidates, valid, 0.0)) == pytest.approx(np.mean([[1, 0], [0, 0]]))


def test_collapsed_codes_satisfy_the_paper_but_not_the_margin_nor_the_balance():
    """The paper's loss is 0 for equal codes, and has no slope that would lead away from them."""
    logits = torch.full((1, 5, 256), 0.7, requires_grad=True)
    valid, candidates = torch.ones(1, 5, dtype=torch.bool), everything_but_the_match(5)
    codes = losses.binary_activation(logits)
    distances = losses.code_distances(codes, codes, rounding=0.01)
    literal = losses.triplet_loss(distances, candidates, valid, margin=0.0)
    literal.backward(retain_graph=True)
    assert literal.item() == 0.0
    assert not logits.grad.any()
    assert losses.triplet_loss(distances, candidates, valid, margin=1.0).item() == pytest.approx(1.0)
    assert losses.balance_loss(torch.tanh(logits), valid).item() == pytest.approx(np.tanh(0.7) ** 2)


def test_contrastive_loss_by_hand():
    a, b = tensor([1.0, 1.0], [1.0, -1.0])[None], tensor([1.0, 1.0], [-1.0, -1.0])[None]
    valid = torch.ones(1, 2, dtype=torch.bool)
    loss = losses.contrastive_loss(a, b, everything_but_the_match(2), valid, temperature=0.5)
    similarity = np.array([[2.0, -2.0], [0.0, 0.0]])
    rows = np.log(np.exp(similarity).sum(1)) - np.diag(similarity)
    columns = np.log(np.exp(similarity).sum(0)) - np.diag(similarity)
    assert float(loss) == pytest.approx(np.mean([rows, columns]))


def test_a_detector_that_knows_nothing_pays_the_logarithm_of_65():
    targets = torch.zeros(1, 16, 16)
    targets[0, 3, 12] = 1.0
    seen = torch.ones(1, 16, 16, dtype=torch.bool)
    assert float(losses.detector_loss(torch.zeros(1, 16, 16), targets, seen)) == pytest.approx(np.log(65.0))


def test_a_detector_that_is_right_pays_nothing_and_what_is_not_seen_does_not_count():
    targets, logits = torch.zeros(1, 16, 8), torch.full((1, 16, 8), -30.0)
    targets[0, 3, 5], logits[0, 3, 5] = 1.0, 30.0
    seen = torch.ones(1, 16, 8, dtype=torch.bool)
    assert float(losses.detector_loss(logits, targets, seen)) == pytest.approx(0.0, abs=1e-6)
    targets[0, 12, 2] = 1.0
    assert float(losses.detector_loss(logits, targets, seen)) > 10.0
    seen[0, 15, 7] = False
    assert float(losses.detector_loss(logits, targets, seen)) == pytest.approx(0.0, abs=1e-6)


def test_more_than_one_keypoint_in_a_cell_share_it():
    targets = torch.zeros(1, 8, 8)
    targets[0, 1, 1] = targets[0, 6, 6] = 1.0
    logits = torch.full((1, 8, 8), -30.0)
    logits[0, 1, 1] = logits[0, 6, 6] = 30.0
    seen = torch.ones(1, 8, 8, dtype=torch.bool)
    assert float(losses.detector_loss(logits, targets, seen)) == pytest.approx(np.log(2.0), abs=1e-6)


def test_the_teacher_is_met_where_the_odds_are_its_own():
    wanted = torch.tensor([[[0.9, 0.2]]])
    valid = torch.ones(1, 1, dtype=torch.bool)
    best = losses.distillation_loss(torch.logit(wanted), wanted, valid)
    assert float(best) == pytest.approx(float(torch.distributions.Bernoulli(wanted).entropy().mean()), rel=1e-5)
    assert float(losses.distillation_loss(torch.zeros(1, 1, 2), wanted, valid)) > float(best)


def test_maps_agree_whatever_their_scale_and_disagree_where_their_peaks_differ():
    peaks = torch.zeros(1, 32, 32)
    peaks[0, 5::8, 5::8] = 0.9
    everywhere = torch.ones(1, 32, 32, dtype=torch.bool)
    assert float(losses.agreement_loss(peaks, 0.5 * peaks, everywhere)) == pytest.approx(0.0, abs=1e-3)
    assert float(losses.agreement_loss(peaks, peaks.roll(1, 2), everywhere)) == pytest.approx(1.0, abs=1e-3)


def test_windows_that_are_not_seen_throughout_do_not_count():
    first, second = torch.rand(1, 32, 32, generator=torch.Generator().manual_seed(1)), torch.zeros(1, 32, 32)
    valid = torch.ones(1, 32, 32, dtype=torch.bool)
    valid[0, 3, 3] = False
    second[valid] = first[valid]
    elsewhere = losses.agreement_loss(first, second, valid)
    assert float(elsewhere) == pytest.approx(0.0, abs=1e-6)
    assert float(losses.agreement_loss(first, second, valid | True)) > float(elsewhere) + 1e-5
    assert float(losses.agreement_loss(first, second, valid & False)) == 0.0
