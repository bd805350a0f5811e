"""The network: it finds keypoints and gives 256 logits for each, whose signs are the bits of its descriptor.

One class has two encoders. `vgg` is that of the paper: pairs of convolutions, three poolings, and a detector head. The
head has 65 channels for each cell of 8 x 8 pixels (64 positions and "none"). Sub-pixel convolution rearranges them to
full resolution. `light` needs a tenth of the computation: strided convolutions, context from 1/16 of the resolution,
and a detector head at half resolution with a sub-pixel step of 2 x 2. It is refined at full resolution and can find
several keypoints in a cell.

All resampling is symmetric about the centre of a pixel block. So cell (r, c) of the logits is centred at the pixel
(8 c + 3.5, 8 r + 3.5), where (0, 0) is the centre of the first pixel.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from fcslam.errors import InputError
from fcslam.features.codes import CODE_BITS
from fcslam.features.dense import CELL_PX
from fcslam.learning.settings import Encoder

_CONTRAST_FLOOR = 1e-4
"""Variance of grey levels in [0, 1] below which an image counts as blank and its contrast is not increased."""


class Maps(NamedTuple):
    """Output of the network for a batch of images."""

    point_logits: Tensor
    """Shape (B, H, W): log odds of a keypoint at a pixel."""
    code_logits: Tensor
    """Shape (B, 256, H/8, W/8): positive where a bit is set."""


Description = tuple[Tensor, Tensor]
"""Output of the layers of the codes for a batch: code logits, shape (B, 256, H/8, W/8), as in ``Maps``; and the context
on which the keypoints depend, shape (B, C, H/8, W/8)."""


class KeypointNetwork(nn.Module):
    """Grey images (B, 1, H, W) in [0, 1], H and W multiples of 8, to ``Maps``."""

    def __init__(self, encoder: Encoder = "light") -> None:
        super().__init__()
        self.encoder: Encoder = encoder
        self.body: LightBody | VggBody = LightBody() if encoder == "light" else VggBody()
        """The encoder and its heads. Its ``code_inputs`` (B, C, H/8, W/8) of images give ``describe`` the codes."""

    def forward(self, image: Tensor) -> Maps:
        """Maps of a batch of images whose height and width are multiples of 8."""
        if image.shape[-1] % CELL_PX or image.shape[-2] % CELL_PX:
            raise ValueError(f"sides must be multiples of {CELL_PX}, not {tuple(image.shape[-2:])}")
        maps: Maps = self.body(image)
        return maps

    def scores(self, maps: Maps) -> Tensor:
        """Probability of a keypoint at every pixel, shape (B, H, W)."""
        if self.encoder == "light":
            return maps.point_logits.sigmoid()
        return cell_probabilities(maps.point_logits)


def layer_names(network: KeypointNetwork, layers: Sequence[nn.Module]) -> set[str]:
    """Names of the parameters and statistics of some layers of a network."""
    values = {id(value) for layer in layers for value in layer.state_dict(keep_vars=True).values()}
    return {name for name, value in network.state_dict(keep_vars=True).items() if id(value) in values}


def network_from_state(encoder: Encoder, state: Mapping[str, Tensor]) -> KeypointNetwork:
    """A network in this state, in evaluation mode."""
    network = KeypointNetwork(encoder)
    try:
        network.load_state_dict(dict(state))
    except RuntimeError as error:
        raise InputError(f"the weights are not those of a {encoder} network ({error})") from error
    network.eval()
    return network


class LightBody(nn.Module):
    """The encoder `light`: about 1.9 GMAC at 640 x 480 pixels.

    Strides of 2 have kernels of 4, which keep blocks centred and alias less than kernels of 3.

    Most widths are multiples of 16, because processors with vectors of 16 floats compute that many channels anyway.
    """

    def __init__(self) -> None:
        super().__init__()
        self.to_half = nn.Sequential(_convolution(1, 16, 4, 2), _convolution(16, 16))
        self.to_quarter = nn.Sequential(_convolution(16, 32, 4, 2), _convolution(32, 32))
        self.to_eighth = nn.Sequential(_convolution(32, 64, 4, 2), _convolution(64, 64), _convolution(64, 64))
        self.to_sixteenth = nn.Sequential(
            nn.MaxPool2d(2, ceil_mode=True), _convolution(64, 96), _convolution(96, 96), _convolution(96, 64, 1)
        )
        self.joint = nn.Sequential(_convolution(64, 64), _convolution(64, 64))
        self.code_head = nn.Sequential(_convolution(64, 128, 1), nn.Conv2d(128, CODE_BITS, 1))
        self.context_eighth = nn.Conv2d(64, 16, 1)
        self.context_quarter = nn.Conv2d(32, 16, 1)
        self.point_head = nn.Sequential(_convolution(16, 16), nn.Conv2d(16, 4, 1))
        # Detection at half resolution depends on whether a point lies on an even pixel; these layers see every pixel.
        self.refine = nn.Sequential(
            _convolution(2, 16), _separable(16), _separable(16), _depthwise(16), nn.Conv2d(16, 1, 1)
        )
        nn.init.zeros_(self.refine[-1].weight)  # the refinement starts as the identity

    @property
    def code_layers(self) -> tuple[nn.Module, ...]:
        """The layers that give the codes at 1/8 of the resolution; the keypoints depend on them a little."""
        return self.to_sixteenth, self.joint, self.code_head

    @property
    def point_layers(self) -> tuple[nn.Module, ...]:
        """The layers that turn features into keypoints; the codes do not depend on them.

        ``context_eighth`` is left out: by it, training of the codes keeps keypoints.
        """
        return self.context_quarter, self.point_head, self.refine

    def code_inputs(self, image: Tensor) -> Tensor:
        """Input of the layers of the codes for images (B, 1, H, W), shape (B, C, H/8, W/8)."""
        return self._resolutions(_even_contrast(image))[-1]

    def describe(self, code_inputs: Tensor) -> Description:
        """The codes for the output of ``code_inputs``."""
        around = _twice(self.to_sixteenth(code_inputs))[..., : code_inputs.shape[-2], : code_inputs.shape[-1]]
        joint = self.joint(code_inputs + around)
        return self.code_head(joint), self.context_eighth(joint)

    def forward(self, image: Tensor) -> Maps:
        """As in ``KeypointNetwork``."""
        image = _even_contrast(image)
        half, quarter, eighth = self._resolutions(image)
        code_logits, context_eighth = self.describe(eighth)
        context = _twice(self.context_quarter(quarter) + _twice(context_eighth))
        points = smoothed(F.pixel_shuffle(self.point_head(half + context), 2))
        points = smoothed(points + self.refine(torch.cat((image, points), dim=1)))
        return Maps(points.squeeze(1), code_logits)

    def _resolutions(self, image: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Features at 1/2, 1/4 and 1/8 of the resolution."""
        half = self.to_half(image)
        quarter = self.to_quarter(half)
        return half, quarter, self.to_eighth(quarter)


class VggBody(nn.Module):
    """The paper's shallow VGG-style network, with batch normalisation."""

    def __init__(self) -> None:
        super().__init__()
        self.encoder = nn.Sequential(
            _convolution(1, 64),
            _convolution(64, 64),
            nn.MaxPool2d(2),
            _convolution(64, 64),
            _convolution(64, 64),
            nn.MaxPool2d(2),
            _convolution(64, 128),
            _convolution(128, 128),
            nn.MaxPool2d(2),
            _convolution(128, 128),
            _convolution(128, 128),
        )
        self.point_head = nn.Sequential(_convolution(128, 256), nn.Conv2d(256, CELL_PX**2 + 1, 1))
        self.code_head = nn.Sequential(_convolution(128, 256), nn.Conv2d(256, CODE_BITS, 1))

    @property
    def code_layers(self) -> tuple[nn.Module, ...]:
        """As in ``LightBody``."""
        return (self.code_head,)

    @property
    def point_layers(self) -> tuple[nn.Module, ...]:
        """As in ``LightBody``."""
        return (self.point_head,)

    def code_inputs(self, image: Tensor) -> Tensor:
        """As in ``LightBody``."""
        features: Tensor = self.encoder(image)
        return features

    def describe(self, code_inputs: Tensor) -> Description:
        """As in ``LightBody``; the keypoints do not depend on the head of the codes."""
        return self.code_head(code_inputs), code_inputs

    def forward(self, image: Tensor) -> Maps:
        """As in ``KeypointNetwork``."""
        features = self.encoder(image)
        cells = self.point_head(features)
        places = cells[:, :-1] - cells[:, -1:]
        return Maps(F.pixel_shuffle(places, CELL_PX).squeeze(1), self.code_head(features))


def cell_probabilities(point_logits: Tensor) -> Tensor:
    """Probability of a keypoint at every pixel (B, H, W): a softmax over each cell's 64 positions and "none"."""
    log_places, _ = cell_log_probabilities(point_logits)
    return F.pixel_shuffle(log_places.exp(), CELL_PX).squeeze(1)


def cell_log_probabilities(point_logits: Tensor) -> tuple[Tensor, Tensor]:
    """Log probabilities of a cell: of its 64 positions (B, 64, H/8, W/8) and of "none" (B, H/8, W/8)."""
    places = F.pixel_unshuffle(point_logits.unsqueeze(1), CELL_PX)
    none = torch.zeros_like(places[:, :1])
    logs = torch.cat((places, none), dim=1).log_softmax(dim=1)
    return logs[:, :-1], logs[:, -1]


def sample_codes(code_logits: Tensor, points_px: Tensor) -> Tensor:
    """Logits (B, N, 256) at points (B, N, 2), x and y in pixels, interpolated linearly in (B, 256, H/8, W/8)."""
    rows, columns = code_logits.shape[-2:]
    size = points_px.new_tensor([columns * CELL_PX, rows * CELL_PX])
    grid = (2.0 * points_px + 1.0) / size - 1.0
    sampled = F.grid_sample(code_logits, grid.unsqueeze(1), mode="bilinear", padding_mode="border", align_corners=False)
    return sampled.squeeze(2).transpose(1, 2)


def smoothed(maps: Tensor) -> Tensor:
    """Maps (B, 1, H, W) after a binomial filter of 3 x 3, which removes patterns that alternate from pixel to pixel.

    It is computed as sums of neighbours, which is much faster on a processor than a convolution.
    """
    sums = F.pad(maps, (1, 1, 1, 1), mode="replicate")
    for _ in range(2):
        sums = sums[..., 1:, :] + sums[..., :-1, :]
        sums = sums[..., 1:] + sums[..., :-1]
    return sums / 16.0


def _convolution(inputs: int, outputs: int, kernel: int = 3, stride: int = 1) -> nn.Sequential:
    convolution = nn.Conv2d(inputs, outputs, kernel, stride, padding=(kernel - stride + 1) // 2, bias=False)
    return nn.Sequential(convolution, nn.BatchNorm2d(outputs), nn.ReLU(inplace=True))


def _separable(channels: int) -> nn.Sequential:
    """A depthwise separable convolution with batch normalisation."""
    mix = nn.Conv2d(channels, channels, 1, bias=False)
    return nn.Sequential(_depthwise(channels), mix, nn.BatchNorm2d(channels), nn.ReLU(inplace=True))


def _depthwise(channels: int) -> nn.Conv2d:
    return nn.Conv2d(channels, channels, 3, padding=1, groups=channels, bias=False)


def _even_contrast(image: Tensor) -> Tensor:
    mean = image.mean(dim=(-2, -1), keepdim=True)
    centred = image - mean
    variance = (centred * centred).mean(dim=(-2, -1), keepdim=True)
    return centred / (variance + _CONTRAST_FLOOR).sqrt()


def _twice(maps: Tensor) -> Tensor:
    return F.interpolate(maps, scale_factor=2.0, mode="bilinear", align_corners=False)
