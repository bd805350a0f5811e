"""What of a robot's images comes back from its weight updates: an attack on federated training.

    FCSLAM_DATA=/path/to/data python benchmarks/update_inversion.py

A server knows the weights that it sent and those that came back, and the settings and the seed of every draw. The robot
trains all layers of the bundled network on photographs of one floor, by the functions of `fcslam tools federate`.

- Recognised: for each image of the floor, the server runs the same training on that image alone. It takes the images
  whose updates are most like the robot's for the robot's: by the cosine of both. Chance is the share of images that the
  robot has.
- Rebuilt, by gradient matching (Geiping et al. 2020): the attacker knows all of the first batch but its pixels: where
  views, keypoints and points lie. It changes grey pixels until their gradient has the direction of the robot's
  update, with a penalty on differences of neighbouring pixels. `gradient` is the plain gradient of one step on one
  pair, which no robot sends; `update` is what a robot sends. PSNR and SSIM are against the pixels of the batch. Grey
  is one grey level, the mean of the batch itself, which the attacker does not know.
"""

from collections.abc import Iterator, Mapping, Sequence

import common
import numpy as np
import torch
from inversion import psnr, structural_similarity, thumbnails
from torch import Tensor

from fcslam.features.detector import BUNDLED_NETWORK, OnnxConfig, OnnxDetector
from fcslam.learning.batches import TrainingBatch, draw_batch
from fcslam.learning.federated.initial_weights import read_onnx_weights, with_batch_statistics
from fcslam.learning.federated.networks import weights_to_network
from fcslam.learning.federated.settings import FederatedSettings
from fcslam.learning.images import read_usable_images
from fcslam.learning.labels import Labels
from fcslam.learning.network import KeypointNetwork
from fcslam.learning.pairs import TrainingExample
from fcslam.learning.settings import TrainingSettings
from fcslam.learning.training_loop import LocalTrainingPlan, local_training, step_losses

FLOOR = "ie_tower/floor20"
SIDE_PX, PAIRS = 64, 4
STEPS = FederatedSettings().local_steps
ITERATIONS, STEP_SIZE, SMOOTHNESS = 150, 0.05, 1e-2
PROBE = 1e-3
"""A second derivative is the difference of first ones over this change of the weights, relative to their length."""
DRAWS = 3
ROBOTS = {"1 image": 1, "4 images": 4, "14 images": 14}
RECOGNISED = {"robot has": "s", "of": "d", "found among as many": ".0%", "chance": ".0%"}
REBUILT = {"from": "s", "batches": "d", "cosine": ".3f", "PSNR, dB": ".2f", "SSIM": ".3f", "PSNR of grey": ".2f",
           "SSIM of grey": ".3f", "recognised": ".0%", "chance": ".0%"}  # fmt: skip


def main() -> None:
    parser = common.options(__doc__)
    parser.add_argument("--images", type=int, default=24, help="of the floor")
    parser.add_argument("--targets", type=int, default=4, help="images that are rebuilt")
    chosen = parser.parse_args()
    torch.set_num_threads(1)
    images = read_usable_images([common.recordings(FLOOR, kind="vision") / FLOOR])[: chosen.images]
    detector = OnnxDetector(OnnxConfig())
    examples = [TrainingExample(image, as_labels(detector, image)) for image in images]
    weights = with_batch_statistics(read_onnx_weights(BUNDLED_NETWORK, "light"), "light", images[::4])
    network = weights_to_network(weights, "light")
    report = common.Report(__file__, __doc__, chosen)
    report.table("Recognised", RECOGNISED, recognised(network, examples))
    report.table("Rebuilt", REBUILT, rebuilt(network, examples[:: len(examples) // chosen.targets][: chosen.targets]))
    report.write()


def as_labels(detector: OnnxDetector, image: np.ndarray) -> Labels:
    found = detector.detect(image)
    return Labels(found.keypoints_px, np.clip(found.scores, 0.1, 1.0))


def settings(pairs: int = PAIRS) -> TrainingSettings:
    whole = FederatedSettings(training=TrainingSettings(pairs=pairs, side_px=SIDE_PX))
    return whole.client_training()


def update(network: KeypointNetwork, examples: Sequence[TrainingExample], pairs: int = PAIRS) -> dict[str, Tensor]:
    """What a round of training takes from each parameter: in the direction of a gradient."""
    trained, _, _ = local_training(network.state_dict(), examples, LocalTrainingPlan(settings(pairs), 0, STEPS))
    after = dict(trained.named_parameters())
    return {name: (value - after[name]).detach() for name, value in network.named_parameters()}


def recognised(network: KeypointNetwork, examples: Sequence[TrainingExample]) -> Iterator[tuple]:
    alone = torch.stack([flat(update(network, [example])) for example in examples])
    rng = np.random.default_rng(1)
    for name, count in ROBOTS.items():
        hits = []
        for _ in range(DRAWS):
            mine = rng.permutation(len(examples))[:count]
            sent = flat(update(network, [examples[k] for k in mine]))
            likely = torch.cosine_similarity(alone, sent[None]).argsort(descending=True)[:count]
            hits.append(np.isin(likely.numpy(), mine).mean())
        yield name, len(examples), float(np.mean(hits)), count / len(examples)


def rebuilt(network: KeypointNetwork, examples: Sequence[TrainingExample]) -> Iterator[tuple]:
    batches = [draw_batch([example], settings(1), 0) for example in examples]
    views = [batch.images[:, 0].numpy() for batch in batches]
    gradients = [gradient(network, batch, batch.images) for batch in batches]
    updates = [update(network, [example], 1) for example in examples]
    for name, known in ("gradient", gradients), ("update", updates):
        made = [rebuild(network, batch, target) for batch, target in zip(batches, known, strict=True)]
        quality = np.mean(
            [likeness(*pair) for pair in zip(views, [picture for picture, _ in made], strict=True)], axis=0
        )
        grey = np.mean([likeness(view, np.full_like(view, view.mean())) for view in views], axis=0)
        truth, found = (thumbnails([255.0 * each[0] for each in them]) for them in (views, [m[0] for m in made]))
        own = np.argmax(found @ truth.T, axis=1) == np.arange(len(views))
        cosine = float(np.mean([reached for _, reached in made]))
        yield name, len(views), cosine, *quality, *grey, float(own.mean()), 1.0 / len(views)


def likeness(views: np.ndarray, pictures: np.ndarray) -> tuple[float, float]:
    """PSNR and SSIM of pictures with grey levels in [0, 1]."""
    pairs = [(255.0 * a, 255.0 * b) for a, b in zip(views, pictures, strict=True)]
    return float(np.mean([psnr((a - b) ** 2) for a, b in pairs])), float(
        np.mean([structural_similarity(a, b).mean() for a, b in pairs])
    )


def flat(arrays: Mapping[str, Tensor]) -> Tensor:
    return torch.cat([each.flatten() for each in arrays.values()])


def loss(network: KeypointNetwork, batch: TrainingBatch, images: Tensor) -> Tensor:
    """The loss of the first step with other pixels."""
    total, _ = step_losses(network.train(), batch._replace(images=images), settings(1), 0)
    return total


def gradient(network: KeypointNetwork, batch: TrainingBatch, images: Tensor) -> dict[str, Tensor]:
    names, parameters = zip(*network.named_parameters(), strict=True)
    return dict(zip(names, torch.autograd.grad(loss(network, batch, images), parameters), strict=True))


def rebuild(network: KeypointNetwork, batch: TrainingBatch, target: Mapping[str, Tensor]) -> tuple[np.ndarray, float]:
    """Pixels (2, S, S) whose gradient has the direction of the target, and the cosine of both."""
    images = torch.full_like(batch.images, 0.5) + 0.02 * torch.randn(
        batch.images.shape, generator=torch.Generator().manual_seed(1)
    )
    optimizer, parameters = torch.optim.Adam([images], lr=STEP_SIZE), list(network.parameters())
    wanted, cosine = flat(target), 0.0
    for iteration in range(ITERATIONS):
        for group in optimizer.param_groups:
            group["lr"] = STEP_SIZE * (1.0 - iteration / ITERATIONS)
        found = flat(gradient(network, batch, images)).requires_grad_()
        likeness_of = torch.cosine_similarity(found, wanted, dim=0)
        cosine = likeness_of.item()
        (direction,) = torch.autograd.grad(1.0 - likeness_of, found)
        step = PROBE * flat(dict(network.named_parameters())).norm() / direction.norm().clamp(min=1e-12)
        sides: list[Tensor] = []
        for sign in (1.0, -2.0, 1.0):  # there, to the other side, and back
            shift(parameters, sign * step * direction)
            if len(sides) < 2:
                pixels = images.detach().requires_grad_()
                sides.append(torch.autograd.grad(loss(network, batch, pixels), pixels)[0])
        pixels = images.detach().requires_grad_()
        rough = sum(pixels.diff(dim=dim).abs().mean() for dim in (-2, -1))
        (smoothing,) = torch.autograd.grad(SMOOTHNESS * rough, pixels)
        images.grad = (sides[0] - sides[1]) / (2.0 * step) + smoothing
        optimizer.step()
        images.clamp_(0.0, 1.0)
    return images[:, 0].numpy(), cosine


@torch.no_grad()
def shift(parameters: Sequence[Tensor], change: Tensor) -> None:
    """Add parts of a vector to parameters in place."""
    parts = change.split([each.numel() for each in parameters])
    for each, part in zip(parameters, parts, strict=True):
        each.add_(part.reshape(each.shape))


if __name__ == "__main__":
    main()
