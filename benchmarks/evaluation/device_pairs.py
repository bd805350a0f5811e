"""Training pairs drawn where the network trains: no benchmark, a part of `detector_training.py`.

`fcslam tools train` draws its pairs on the processor (`learning/pairs.py`). A graphics card would wait for them.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F

from fcslam.learning.batches import TrainingBatch
from fcslam.learning.pairs import BORDER_PX, GRID_SHARE, SHIFT_SHARE, TrainingExample
from fcslam.learning.warps import LARGEST_SHIFT_PX

MOST_KEYPOINTS = 400
RIM_PX = 2
"""Pixels closer to an image's border than this do not count as seen."""
KERNEL_PX = 9


@dataclass(frozen=True)
class Change:
    """How far the views of a pair may differ."""

    turn_rad: float
    """Standard deviation of a view's turn."""
    any_turn_share: float
    """Share of views that are turned by any angle."""
    scale_spread: float
    """The scales of two views differ by at most the factor exp of this."""
    tilt: float
    """Largest displacement of a corner of a view, as a share of its side."""


@dataclass(frozen=True)
class Photographs:
    """Images with their labels on one device."""

    images: Tensor
    """Shape (K, H, W), uint8; each image fills the upper left corner."""
    sizes: Tensor
    """Shape (K, 2): width and height."""
    keypoints: Tensor
    """Shape (K, P, 2) [px]."""
    quality: Tensor
    """Shape (K, P), 0 where there is no keypoint."""

    @classmethod
    def of(cls, examples: Sequence[TrainingExample], device: torch.device) -> "Photographs":
        sides = np.max([example.image.shape for example in examples], axis=0)
        images = torch.zeros(len(examples), *sides, dtype=torch.uint8)
        keypoints, quality = torch.zeros(len(examples), MOST_KEYPOINTS, 2), torch.zeros(len(examples), MOST_KEYPOINTS)
        for row, example in enumerate(examples):
            height, width = example.image.shape
            images[row, :height, :width] = torch.from_numpy(example.image)
            best = example.labels.keypoints[:MOST_KEYPOINTS]
            keypoints[row, : len(best)] = torch.from_numpy(best)
            quality[row, : len(best)] = torch.from_numpy(example.labels.quality[:MOST_KEYPOINTS])
        sizes = torch.tensor([example.image.shape[::-1] for example in examples])
        return cls(*(each.to(device) for each in (images, sizes, keypoints, quality)))


def draw_on_device(
    photographs: Photographs,
    pairs: int,
    side: int,
    points: int,
    changes: Sequence[Change],
    generator: torch.Generator,
) -> TrainingBatch:
    """A batch of pairs of square views, as `draw_pair` draws them, but for compression; as many of each change."""
    count = pairs // len(changes)
    batches = [_draw(photographs, count, side, points, change, generator) for change in changes]

    def joined(name: str) -> Tensor:
        parts = [getattr(batch, name) for batch in batches]
        sides = len(parts[0]) // count  # 2 where there is a row for each view
        return torch.cat([part for view in zip(*(part.chunk(sides) for part in parts), strict=True) for part in view])

    return TrainingBatch(**{each: joined(each) for each in TrainingBatch._fields})


def _draw(
    photographs: Photographs, pairs: int, side: int, points: int, change: Change, generator: torch.Generator
) -> TrainingBatch:
    device = photographs.images.device
    rows = torch.randint(len(photographs.images), (pairs,), generator=generator, device=device)
    window = _windows(photographs.sizes[rows], side, generator)
    first, second = (_changes(pairs, side, change, generator) @ window for _ in range(2))
    shifted = _uniform((pairs, 1, 1), 0.0, 1.0, generator) < SHIFT_SHARE
    second = torch.where(shifted, _shifts(pairs, generator) @ first, second)
    change_of_view = second @ torch.linalg.inv(first)
    keypoints, quality = photographs.keypoints[rows], photographs.quality[rows]
    points_of = [warped(H, keypoints) for H in (first, second)]
    both = (quality > 0.0) & _inside(points_of[0], side) & _inside(points_of[1], side)
    anywhere = _uniform((pairs, points, 2), 0.0, side - 1.0, generator)
    best = round((1.0 - GRID_SHARE) * points)
    noise = -_uniform(quality.shape, 1e-6, 1.0, generator).log().neg().clamp(min=1e-9).log()
    # Gumbel's trick, as in `draw_pair`.
    appeal, chosen = torch.where(both, quality.clamp(min=1e-6).log() + noise, -torch.inf).topk(best, dim=1)
    at_keypoints = points_of[0].gather(1, chosen[..., None].expand(-1, -1, 2))
    anywhere[:, :best] = torch.where(torch.isfinite(appeal)[..., None], at_keypoints, anywhere[:, :best])
    there = warped(change_of_view, anywhere)
    in_image = warped(torch.linalg.inv(first), anywhere)
    shown = ((in_image >= 0.0) & (in_image <= photographs.sizes[rows][:, None] - 1.0)).all(-1)
    homographies = torch.cat((first, second))
    views, seen = _views(photographs, rows.repeat(2), homographies, side)
    none = torch.zeros(pairs, 0, device=device)
    return TrainingBatch(
        images=relit(views, generator),
        targets=torch.cat([_splat(each, quality, side) for each in points_of]),
        seen=seen,
        points=torch.cat((anywhere, there)).nan_to_num(),
        valid=shown & _inside(anywhere, side) & _inside(there, side),
        teacher_points=none.reshape(pairs, 0, 1).repeat(2, 1, 2),
        teacher_valid=none.bool(),
        teacher_descriptors=none.reshape(pairs, 0, 1),
        homographies=change_of_view,
    )


def warped(homographies: Tensor, points: Tensor) -> Tensor:
    """Points (B, N, 2) under homographies (B, 3, 3)."""
    moved = points @ homographies[:, :, :2].transpose(1, 2) + homographies[:, None, :, 2]
    return moved[..., :2] / moved[..., 2:]


def relit(views: Tensor, generator: torch.Generator) -> Tensor:
    """Views (B, 1, S, S) in [0, 1] with other light, lens and sensor, as `relight` draws them, but for compression."""
    count, side = len(views), views.shape[-1]

    def draw(low: float, high: float, share: float = 1.0, otherwise: float = 0.0) -> Tensor:
        values = _uniform((count, 1, 1, 1), low, high, generator)
        return torch.where(_uniform(values.shape, 0.0, 1.0, generator) < share, values, otherwise)

    views = views.clamp(min=1e-4) ** draw(np.log(0.45), np.log(2.2), 0.5).exp()
    y, x = torch.meshgrid(*2 * [torch.arange(side, device=views.device, dtype=views.dtype)], indexing="ij")
    turn = draw(0.0, np.pi)
    u, v = x - draw(0.0, side), y - draw(0.0, side)
    along, across = (turn.cos() * u + turn.sin() * v) / draw(10.0, 0.75 * side), (turn.cos() * v - turn.sin() * u)
    radius = (along.square() + (across / draw(10.0, 0.75 * side)).square()).sqrt()
    views = views * (1.0 + draw(-0.7, 0.6, 0.3) * torch.sigmoid((1.0 - radius) / draw(0.03, 0.5)))
    views = (views - 0.5) * draw(np.log(0.35), np.log(1.6)).exp() + 0.5 + draw(-0.2, 0.2)
    views = _blurred(views, generator)
    noise = torch.empty_like(views).normal_(generator=generator)
    return (views + draw(0.0, 0.04, 0.8) * noise).clamp(0.0, 1.0)


def _uniform(shape: Sequence[int], low: float, high: float, generator: torch.Generator) -> Tensor:
    return torch.empty(*shape, device=generator.device).uniform_(low, high, generator=generator)


def _inside(points: Tensor, side: int) -> Tensor:
    return ((points >= BORDER_PX) & (points <= side - 1.0 - BORDER_PX)).all(-1)


def _windows(sizes: Tensor, side: int, generator: torch.Generator) -> Tensor:
    """As `random_view`."""
    count = len(sizes)
    zoom = _uniform((count,), np.log(0.7), np.log(1.5), generator).exp()
    zoom = torch.minimum(zoom, 1.15 * sizes.amin(1) / side)
    free = (sizes - zoom[:, None] * side).clamp(min=0.0)
    corner = _uniform((count, 2), 0.0, 1.0, generator) * free
    windows = torch.eye(3, device=sizes.device).repeat(count, 1, 1)
    windows[:, :2, :2] /= zoom[:, None, None]
    windows[:, :2, 2] = -corner / zoom[:, None]
    return windows


def _changes(count: int, side: int, change: Change, generator: torch.Generator) -> Tensor:
    """As `random_change`, with another width: homographies (count, 3, 3) of a view onto itself."""
    device = generator.device
    any_turn = _uniform((count,), -np.pi, np.pi, generator)
    little = torch.empty(count, device=device).normal_(0.0, change.turn_rad, generator=generator)
    turn = torch.where(_uniform((count,), 0.0, 1.0, generator) < change.any_turn_share, any_turn, little)
    scale = (_uniform((count,), -0.5, 0.5, generator) * change.scale_spread).exp()
    cos, sin = scale * turn.cos(), scale * turn.sin()
    rotation = torch.stack((torch.stack((cos, -sin), -1), torch.stack((sin, cos), -1)), -2)
    corners = torch.tensor([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]], device=device) * (side - 1.0)
    middle = 0.5 * (side - 1.0)
    tilted = corners + _uniform((count, 4, 2), -change.tilt * side, change.tilt * side, generator)
    shift = _uniform((count, 1, 2), -0.1 * side, 0.1 * side, generator)
    return _homographies(corners, (tilted - middle) @ rotation.transpose(1, 2) + middle + shift)


def _homographies(corners: Tensor, moved: Tensor) -> Tensor:
    """Homographies (B, 3, 3) that take four corners (4, 2) to others (B, 4, 2)."""
    x, y = corners.double().expand(len(moved), -1, -1).unbind(-1)
    u, v = moved.double().unbind(-1)
    one, zero = torch.ones_like(x), torch.zeros_like(x)
    upper = torch.stack((x, y, one, zero, zero, zero, -x * u, -y * u), -1)
    lower = torch.stack((zero, zero, zero, x, y, one, -x * v, -y * v), -1)
    solved = torch.linalg.solve(torch.cat((upper, lower), 1), torch.cat((u, v), 1))
    return torch.cat((solved, one[:, :1]), 1).reshape(-1, 3, 3).float()


def _shifts(count: int, generator: torch.Generator) -> Tensor:
    shifts = torch.eye(3, device=generator.device).repeat(count, 1, 1)
    size = (count, 2)
    drawn = torch.randint(-LARGEST_SHIFT_PX, LARGEST_SHIFT_PX + 1, size, generator=generator, device=generator.device)
    shifts[:, :2, 2] = drawn.float()
    return shifts


def _views(photographs: Photographs, rows: Tensor, homographies: Tensor, side: int) -> tuple[Tensor, Tensor]:
    """Views (B, 1, S, S) of images, each pixel the mean of four samples, and which pixels show the image (B, S, S)."""
    images, limits = photographs.images[rows].float().unsqueeze(1) / 255.0, photographs.sizes[rows][:, None] - 1.0
    y, x = torch.meshgrid(*2 * [torch.arange(side, device=rows.device, dtype=torch.float32)], indexing="ij")
    pixels = torch.stack((x, y), -1).reshape(1, -1, 2)
    back = torch.linalg.inv(homographies)
    whole = images.new_tensor(images.shape[:-3:-1]) - 1.0
    total = torch.zeros(len(rows), 1, side, side, device=rows.device)
    for offset in (-0.25, -0.25), (-0.25, 0.25), (0.25, -0.25), (0.25, 0.25):
        source = warped(back, pixels + images.new_tensor(offset))
        source = limits - (limits - source.nan_to_num().remainder(2.0 * limits)).abs()  # mirrored, as in `warp_image`
        grid = (2.0 * source / whole - 1.0).reshape(-1, side, side, 2)
        total += F.grid_sample(images, grid, mode="bilinear", padding_mode="border", align_corners=True)
    source = warped(back, pixels)
    seen = ((source >= RIM_PX) & (source <= limits - RIM_PX)).all(-1)
    return total / 4.0, seen.reshape(-1, side, side)


def _splat(points: Tensor, quality: Tensor, side: int) -> Tensor:
    """As `splat_points`, for points (B, P, 2) of weights (B, P): shape (B, S, S)."""
    here = (quality > 0.0) & ((points >= 0.0) & (points <= side - 1.0)).all(-1)
    points = torch.where(here[..., None], points, 0.0)
    weight = torch.where(here, quality, 0.0)
    low = points.floor()
    part = points - low
    maps = torch.zeros(len(points), (side + 1) ** 2, device=points.device)
    for row in (0, 1):
        for column in (0, 1):
            share = (1 - column - part[..., 0]).abs() * (1 - row - part[..., 1]).abs()
            cell = (low[..., 1] + row) * (side + 1) + low[..., 0] + column
            maps.scatter_add_(1, cell.long(), weight * share)
    return maps.reshape(-1, side + 1, side + 1)[:, :-1, :-1]


def _blurred(views: Tensor, generator: torch.Generator) -> Tensor:
    """Three of ten views blurred, half of them by motion: by a Gaussian of another width along than across."""
    count = len(views)

    def draw(low: float, high: float) -> Tensor:
        return _uniform((count, 1, 1), low, high, generator)

    turn, motion, width = draw(0.0, np.pi), draw(0.0, 1.0) < 0.5, draw(0.4, 1.6)
    sharp = draw(0.0, 1.0) > 0.3
    along = torch.where(sharp, 0.05, width)
    across = torch.where(sharp, 0.05, torch.where(motion, 0.3, width))
    steps = torch.arange(KERNEL_PX, device=views.device) - KERNEL_PX // 2
    y, x = torch.meshgrid(steps, steps, indexing="ij")
    u, v = turn.cos() * x + turn.sin() * y, turn.cos() * y - turn.sin() * x
    kernels = torch.exp(-0.5 * ((u / along).square() + (v / across).square()))
    kernels = kernels / kernels.sum((-2, -1), keepdim=True)
    padded = F.pad(views, 4 * [KERNEL_PX // 2], mode="reflect").transpose(0, 1)
    return F.conv2d(padded, kernels.unsqueeze(1), groups=count).transpose(0, 1)
