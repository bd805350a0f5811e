"""Shapes of the network's maps, where its cells are, and that nothing is tied to a corner of the image."""

import pytest
import torch

from fcslam.learning.network import KeypointNetwork, cell_log_probabilities, cell_probabilities, sample_codes, smoothed

encoders = pytest.mark.parametrize("encoder", ["light", "vgg"])


def network(encoder):
    torch.manual_seed(0)
    return KeypointNetwork(encoder).eval()


@encoders
@pytest.mark.parametrize("size", [(64, 96), (72, 88), (8, 8)])
def test_maps_cover_the_image(encoder, size):
    net = network(encoder)
    maps = net(torch.rand(2, 1, *size))
    assert maps.point_logits.shape == (2, *size)
    assert maps.code_logits.shape == (2, 256, size[0] // 8, size[1] // 8)
    scores = net.scores(maps)
    assert scores.shape == (2, *size)
    assert ((scores > 0.0) & (scores < 1.0)).all()


@encoders
def test_other_sizes_are_refused(encoder):
    with pytest.raises(ValueError, match="multiples of 8"):
        network(encoder)(torch.rand(1, 1, 60, 64))


@pytest.mark.parametrize(("encoder", "most"), [("light", 0.6e6), ("vgg", 1.31e6)])
def test_networks_are_small(encoder, most):
    assert sum(parameter.numel() for parameter in network(encoder).parameters()) < most


def test_the_probabilities_of_a_cell_sum_to_one():
    logits = torch.randn(1, 16, 24)
    places = cell_probabilities(logits).unfold(1, 8, 8).unfold(2, 8, 8).sum((-1, -2))
    none = cell_log_probabilities(logits)[1].exp()
    assert torch.allclose(places + none, torch.ones(1, 2, 3))
    assert cell_probabilities(logits)[0, 5, 13].item() == pytest.approx(
        (logits[0, 5, 13].exp() / (1.0 + logits[0, :8, 8:16].exp().sum())).item(), rel=1e-5
    )


def test_a_cells_logits_are_at_its_centre_and_interpolated_between():
    logits = torch.randn(1, 256, 4, 5)
    points = torch.tensor([[[8 * 3 + 3.5, 8 * 2 + 3.5], [8 * 3 + 7.5, 8 * 2 + 3.5]]])
    sampled = sample_codes(logits, points)
    assert torch.allclose(sampled[0, 0], logits[0, :, 2, 3], atol=1e-5)
    assert torch.allclose(sampled[0, 1], logits[0, :, 2, 3:5].mean(-1), atol=1e-5)


@encoders
def test_symmetric_kernels_see_mirrored_images_mirrored(encoder):
    """Cells are centred in their blocks of pixels: else this holds nowhere."""
    net = network(encoder)
    for parameter in net.parameters():
        if parameter.ndim == 4:
            parameter.data = (parameter.data + parameter.data.flip(-1)) / 2
    image = torch.rand(1, 1, 48, 64)
    mirrored = net(image.flip(-1)).code_logits.flip(-1)
    assert torch.allclose(net(image).code_logits, mirrored, atol=1e-4)


def test_the_light_detector_has_no_grid_of_cells():
    """Rolled by two pixels, what it sees moves by two pixels, away from the rim, up to the context that is coarser."""
    net = network("light")
    net.body.context_eighth.weight.data.zero_()
    net.body.context_quarter.weight.data.zero_()
    image = torch.rand(1, 1, 64, 64)
    rolled = net(image.roll((2, 2), (-2, -1))).point_logits.roll((-2, -2), (-2, -1))
    assert torch.allclose(net(image).point_logits[0, 12:-12, 12:-12], rolled[0, 12:-12, 12:-12], atol=1e-4)


def test_what_alternates_from_pixel_to_pixel_does_not_reach_the_keypoints():
    """Sub-pixel convolution fills even and odd pixels from other channels; the smoothing makes them equal."""
    rows, columns = torch.meshgrid(torch.arange(12), torch.arange(16), indexing="ij")
    for pattern in (rows % 2, columns % 2, (rows + columns) % 2):
        smooth = smoothed(pattern[None, None].float())
        assert torch.allclose(smooth[..., 1:-1, 1:-1], torch.tensor(0.5))
    plane = (2.0 * columns - rows)[None, None].float()
    assert torch.allclose(smoothed(plane)[..., 1:-1, 1:-1], plane[..., 1:-1, 1:-1], atol=1e-5)
