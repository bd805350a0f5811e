"""Training of the bundled networks on a graphics card: wider changes of view, and the paper's equations alone.

    python benchmarks/detector_training.py --networks FOLDER [--images FOLDER ...] [--minutes 8] [--arms wide ...]

FOLDER keeps the networks; those that it lacks are trained, all at the same time, on photographs of FCSLAM_DATA that no
table measures, and on --images, such as renders. Pairs are drawn on the device (`evaluation/device_pairs.py`).

- near, wide, turns: the light network from the bundled one, with the losses of `fcslam tools train` and the
  loss of `evaluation/subpixel_loss.py`, in float32. Views change as in `fcslam tools train` in `near`. In the
  others, the scales of a pair differ by up to 4; in `wide` views turn by 26 degrees (standard deviation), in `turns`
  half of them by any angle. Labels are those of the bundled network and of Harris's measure
- longer, mixed: `near`, trained on. A quarter of the pairs of `mixed` change as in `wide`. The learning rate rises
  again and falls as a cosine in the second half. `mean` has the mean of the weights of both ("model soup")
- ours, hardest: the paper's network from `vgg`. The latter has eqs. (1)-(3) alone for its codes, without a margin, with
  the hardest negative of a pair; `ours` has the losses of `fcslam tools train`. As many steps each
- corners: the paper's network from `vgg`, with labels that OpenCV's cornerSubPix moves to corners, and the localization
  loss: `vgg` puts keypoints several pixels inside light fields (`corners.py`)

Codes: of points of 32 pairs of held-out images: bits that differ between different points of a view, and between both
views of a point; bits that are equal at 98 % of the points; points whose nearest code in the other view is their own.

Development tables: copies of held-out photographs of a corridor, a desk and a tower under random homographies
(`made_pairs.py`), and eight pairs of "homogr" (Lebeda et al.), with the scales of `benchmarks/homography.py`.
They choose a network; `homography.py` then measures this one on its 25 pairs.
"""

import csv
import math
import multiprocessing
import os
import tempfile
import time
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import common
import torch
from evaluation.baselines import moved_to_corners
from evaluation.device_pairs import Change, Photographs, draw_on_device
from evaluation.subpixel_loss import localization_loss
from torch import Tensor

from fcslam.features.detector import BUNDLED_NETWORK
from fcslam.learning.batches import POINTS, TrainingBatch
from fcslam.learning.export import export_onnx
from fcslam.learning.federated.initial_weights import prepare_initial_weights, read_onnx_weights
from fcslam.learning.federated.networks import weights_to_network
from fcslam.learning.images import ImageFile, find_images
from fcslam.learning.network import KeypointNetwork, sample_codes
from fcslam.learning.objective import LOSSES, LossWeights, grid_shift, negatives, objective
from fcslam.learning.pairs import TrainingExample
from fcslam.learning.settings import TrainingSettings
from fcslam.learning.stages import keypoint_response, label_images, read_images
from fcslam.learning.trainer import AVERAGE_DECAY
from fcslam.learning.training_loop import CLIP_NORM, create_optimizer, learning_rate

SOURCES = (
    "bsds500", "coco_subset", "urban100", "sun_hays80", "kodak24", "icl_nuim_snippet", "camvid", "ie_tower",
    "openimages_doors", "tum_rgbd/freiburg1_desk_snippet/rgb", "tum_rgbd/freiburg2_desk_snippet/rgb",
    "tum_rgbd/freiburg3_cabinet_58/rgb", "tum_rgbd/freiburg3_long_office_household_snippet/rgb",
)  # fmt: skip
UNSEEN = tuple(f"ie_tower/floor{number}/" for number in range(11, 16))
LABELS = TrainingSettings(label_copies=4)
EQUATIONS_STEPS = 1000
WATCH_EVERY = 50
WATCHED_PAIRS = 32
STUCK_SHARE = 0.98
SEED = 1
MADE_IMAGES = 90
PLANES = tuple(
    f"homogr/{name}"
    for name in ("Boston", "BruggeSquare", "BruggeTower", "CapitalRegion", "LePoint1", "LePoint2", "LePoint3", "city")
)
"""Without `graf`, which is one of the 25 pairs."""
CODES = {"arm": "s", "step": "d", "bits that differ: other points": ".1f", "the same point": ".1f", "stuck bits": "d",
         "nearest code is its own": ".3f", "keypoint loss": ".3f"}  # fmt: skip


@dataclass(frozen=True)
class Arm:
    """What a network is trained on."""

    settings: TrainingSettings
    changes: tuple[Change, ...]
    """A batch has as many pairs of each."""
    localization: float = 0.0
    """Weight of the localization loss."""
    start: Path = BUNDLED_NETWORK
    losses: LossWeights = LOSSES["default"]
    points: int = POINTS
    """Points of a pair whose descriptors are compared."""
    steps: int | None = None
    """None: as many as the time allows."""
    after: str | None = None
    """The arm whose network is trained on."""
    at_corners: bool = False
    """Whether labels move to the nearest corner of the image."""


def light(*changes: Change, after: str | None = None) -> Arm:
    settings = TrainingSettings(pairs=64, side_px=256, learning_rate=1e-3)
    return Arm(settings, changes, points=448, localization=2.0, after=after)


def vgg(**loss: Any) -> Arm:
    settings = TrainingSettings(encoder="vgg", pairs=32, side_px=192, learning_rate=5e-4, steps=EQUATIONS_STEPS)
    return Arm(settings, (AS_IN_TRAINING,), losses=LossWeights(**loss), start=Path("vgg"), steps=EQUATIONS_STEPS)


AS_IN_TRAINING = Change(turn_rad=0.2, any_turn_share=0.1, scale_spread=0.7, tilt=0.12)
"""Those of `learning/warps.py`."""
WIDE = Change(turn_rad=0.45, any_turn_share=0.1, scale_spread=1.4, tilt=0.16)
EQUATIONS: dict[str, Any] = {
    "margin": 0.0, "rounding": 1e-6, "contrastive": 0.0, "distillation": 0.0, "balance": 0.0, "agreement": 0.0,
}  # fmt: skip
ARMS = {
    "near": light(AS_IN_TRAINING),
    "wide": light(WIDE),
    "turns": light(Change(turn_rad=0.45, any_turn_share=0.5, scale_spread=1.4, tilt=0.16)),
    "longer": light(AS_IN_TRAINING, after="near"),
    "mixed": light(*3 * [AS_IN_TRAINING], WIDE, after="near"),
    "ours": vgg(),
    "hardest": vgg(**EQUATIONS),
    "corners": Arm(
        TrainingSettings(encoder="vgg", pairs=32, side_px=192, learning_rate=5e-4),
        (AS_IN_TRAINING,),
        localization=2.0,
        start=Path("vgg"),
        at_corners=True,
    ),
}
MEAN_OF = ("longer", "mixed")
WARM_SHARE, FALL_SHARE, LAST_RATE = 0.02, 0.5, 2e-6
"""Schedule of an arm that continues another one."""


@dataclass
class Watch:
    """Rows of what a training did, in a file."""

    path: Path
    batch: TrainingBatch
    rows: list[tuple] = field(default_factory=list)

    def look(self, arm: str, step: int, network: KeypointNetwork, parts: dict[str, Tensor]) -> None:
        self.rows.append((arm, step, *codes(network, self.batch), parts["detector"].item()))
        with self.path.open("w", newline="", encoding="utf-8") as file:
            csv.writer(file).writerows(self.rows)


def main() -> None:
    parser = common.options(__doc__ or "")
    parser.add_argument("--networks", type=Path, required=True, help="folder of the networks")
    parser.add_argument("--images", type=Path, nargs="+", default=[], help="folders of more images to train on")
    parser.add_argument("--labels", type=Path, help="folder that keeps the labels; default: in that of the networks")
    parser.add_argument("--minutes", type=float, default=8.0, help="of training")
    parser.add_argument("--arms", nargs="+", choices=ARMS, default=list(ARMS), help="which networks")
    parser.add_argument("--train-only", action="store_true", help="on a machine that only trains: no report")
    chosen = parser.parse_args()
    missing = [arm for arm in chosen.arms if not watched(chosen.networks, arm).exists()]
    if missing:
        vision = common.recordings(*SOURCES, kind="vision")
        for arms in ([arm for arm in missing if (ARMS[arm].after is None) is first] for first in (True, False)):
            if arms:
                train(arms, [vision / name for name in SOURCES] + chosen.images, chosen)
    if not chosen.train_only:
        measure(chosen)


def watched(folder: Path, arm: str) -> Path:
    return folder / f"{arm}.csv"


def train(arms: list[str], roots: list[Path], chosen: Any) -> None:
    """Train networks side by side."""
    chosen.networks.mkdir(parents=True, exist_ok=True)
    files = [file for file in find_images(roots) if not file.name.startswith(UNSEEN)]
    workers = os.cpu_count() or 1
    began = time.monotonic()
    label = partial(labelled, cache=chosen.labels or chosen.networks / "labels")
    context = multiprocessing.get_context("spawn")  # a forked process cannot use a graphics card
    with ProcessPoolExecutor(workers, context) as pool:
        parts = list(pool.map(label, [files[part::workers] for part in range(workers)]))
    train_on, held_out = ([example for part in parts for example in part[side]] for side in (0, 1))
    print(f"{time.monotonic() - began:.0f} s: {len(train_on)} images, {len(held_out)} held out", flush=True)
    ends = time.time() + 60.0 * chosen.minutes
    processes = [
        context.Process(target=train_arm, args=(arm, train_on, held_out, chosen.networks, ends)) for arm in arms
    ]
    for process in processes:
        process.start()
    for process in processes:
        process.join()


def labelled(files: list[ImageFile], cache: Path) -> tuple[list[TrainingExample], list[TrainingExample]]:
    torch.set_num_threads(1)
    network = weights_to_network(read_onnx_weights(BUNDLED_NETWORK, LABELS.encoder), LABELS.encoder).eval()
    response = keypoint_response(network, torch.device("cpu"))
    found = label_images(read_images(files), cache, LABELS, response)
    return found.train, found.held_out


def at_corners(example: TrainingExample) -> TrainingExample:
    """The same image with its keypoints at the nearest corners."""
    points = moved_to_corners(example.image, example.labels.keypoints)
    return replace(example, labels=replace(example.labels, keypoints=points))


def bundled(start: Path, settings: TrainingSettings, folder: Path, images: list[TrainingExample]) -> KeypointNetwork:
    """A network that comes with fcslam, with the statistics of images."""
    public = [example.image for example in images]
    weights = prepare_initial_weights(start, folder, settings.encoder, public)
    return weights_to_network(weights, settings.encoder)


def train_arm(
    name: str, train_on: list[TrainingExample], held_out: list[TrainingExample], folder: Path, ends: float
) -> None:
    """Train a network until its steps are done or its time is over, and keep it on the way."""
    arm, settings = ARMS[name], ARMS[name].settings
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    torch.manual_seed(SEED)
    torch.set_num_threads(2)
    torch.backends.cuda.matmul.allow_tf32 = True
    torch.backends.cudnn.benchmark = True
    (folder / name).mkdir(exist_ok=True)
    start = arm.start if arm.after is None else folder / f"{arm.after}.onnx"
    if arm.at_corners:
        train_on = [at_corners(example) for example in train_on]
    network = bundled(start, settings, folder / name, train_on).to(device, memory_format=torch.channels_last)
    average = KeypointNetwork(settings.encoder).to(device).eval()
    average.load_state_dict(network.state_dict())
    optimizer = create_optimizer(network)
    draw = partial(draw_on_device, side=settings.side_px, points=arm.points, changes=arm.changes)
    photographs = Photographs.of(train_on, device)
    generator = torch.Generator(device).manual_seed(SEED)
    seen = draw(Photographs.of(held_out, device), WATCHED_PAIRS, generator=torch.Generator(device).manual_seed(SEED))
    watch, begins, step, progress = Watch(watched(folder, name), seen), time.time(), 0, 0.0
    parts = {"detector": torch.zeros(())}
    watch.look(name, 0, average, parts)
    while progress < 1.0:
        for group in optimizer.param_groups:
            group["lr"] = rate(arm, progress)
        batch = draw(photographs, settings.pairs, generator=generator)
        maps = network.train()(batch.images.contiguous(memory_format=torch.channels_last))
        shift = grid_shift(settings.encoder, SEED, step)
        total, parts = objective(maps, batch, arm.losses, progress, shift, None)
        if arm.localization:
            parts["localization"] = localization_loss(maps.point_logits.float().sigmoid(), batch.homographies)
            total = total + arm.localization * parts["localization"]
        optimizer.zero_grad(set_to_none=True)
        total.backward()
        if torch.isfinite(torch.nn.utils.clip_grad_norm_(network.parameters(), CLIP_NORM)):
            optimizer.step()
        else:
            print(f"{name} {step}: left out, because it is not finite: {parts}", flush=True)
        follow(average, network, step)
        step += 1
        share_of_time = (time.time() - begins) / max(ends - begins, 1e-3)
        progress = share_of_time if arm.steps is None else max(step / arm.steps, share_of_time)
        if step % (WATCH_EVERY if arm.steps else 500) == 0 or progress >= 1.0:
            watch.look(name, step, network if arm.steps else average, parts)
            print(f"{name} {step} {progress:.3f}", *(f"{key} {value.item():.4f}" for key, value in parts.items()),
                  *(f"{value:.3f}" for value in watch.rows[-1][2:]), flush=True)  # fmt: skip
    if arm.steps is None:
        torch.save(average.state_dict(), folder / f"{name}.pt")
        keep(average, folder / f"{name}.onnx")


def rate(arm: Arm, progress: float) -> float:
    """Learning rate after a share of the training."""
    shown = arm.settings.model_copy(update={"steps": 10_000})  # the schedules depend on the share that is done alone
    if arm.after is None:
        return learning_rate(shown, int(progress * shown.steps))
    warm = min(progress / WARM_SHARE + 1e-3, 1.0)
    fallen = 0.5 - 0.5 * math.cos(math.pi * max(progress - 1.0 + FALL_SHARE, 0.0) / FALL_SHARE)
    return warm * (shown.learning_rate + fallen * (LAST_RATE - shown.learning_rate))


def keep_mean(folder: Path) -> Path:
    """The network with the mean of the weights of other ones."""
    path = folder / "mean.onnx"
    states = [torch.load(folder / f"{name}.pt", map_location="cpu") for name in MEAN_OF]
    mean = KeypointNetwork("light")
    mean.load_state_dict({name: sum(state[name] for state in states) / len(states) for name in states[0]})
    keep(mean, path)
    return path


def follow(average: KeypointNetwork, network: KeypointNetwork, step: int) -> None:
    """The moving average of the weights, as in `learning/trainer.py`."""
    decay = min(AVERAGE_DECAY, (1.0 + step) / (10.0 + step))
    means, values = ([*each.state_dict().values()] for each in (average, network))
    real = [row for row, value in enumerate(values) if value.is_floating_point()]
    with torch.no_grad():
        torch._foreach_lerp_([means[row] for row in real], [values[row] for row in real], 1.0 - decay)


def keep(network: KeypointNetwork, path: Path) -> None:
    copy = KeypointNetwork(network.encoder)
    copy.load_state_dict(network.state_dict())
    export_onnx(copy, path)


@torch.inference_mode()
def codes(network: KeypointNetwork, batch: TrainingBatch) -> tuple[float, float, int, float]:
    """The columns of the table of codes but the loss."""
    training = network.training
    bits = sample_codes(network.eval()(batch.images).code_logits.float(), batch.points) >= 0.0
    network.train(training)
    first, second = bits.float().chunk(2)
    gaps = first.shape[-1] - first @ second.transpose(1, 2) - (1.0 - first) @ (1.0 - second).transpose(1, 2)
    within = first.shape[-1] - first @ first.transpose(1, 2) - (1.0 - first) @ (1.0 - first).transpose(1, 2)
    others = negatives(batch.points, batch.valid)
    own = gaps.diagonal(dim1=1, dim2=2)
    nearest = own < torch.where(others, gaps, float("inf")).amin(-1)
    ones = first[batch.valid].mean(0)
    stuck = torch.maximum(ones, 1.0 - ones) >= STUCK_SHARE
    return (
        float(within[others].mean()),
        float(own[batch.valid].mean()),
        int(stuck.sum()),
        float(nearest[batch.valid].float().mean()),
    )


def measure(chosen: Any) -> None:
    """The report of networks that are trained."""
    from evaluation.detectors import EvaluatedDetectorKind, choose_detectors, find_scenes
    from evaluation.homography import MATCHING_NMS_PX, evaluate_homography, mean
    from made_pairs import MEASURES, make_scenes  # a machine that trains may lack what measures

    report = common.Report(__file__, __doc__ or "", chosen)
    vision = common.recordings(*PLANES, kind="vision")
    report.table("Codes while training", CODES, code_rows(chosen.networks, chosen.arms))
    weights = {"bundled": BUNDLED_NETWORK} | {
        arm: chosen.networks / f"{arm}.onnx" for arm in chosen.arms if ARMS[arm].steps is None
    }
    if set(MEAN_OF) <= set(chosen.arms):
        weights["mean"] = keep_mean(chosen.networks)
    columns = {"": "s", "NMS": "d"} | dict.fromkeys(MEASURES, ".3f")
    with tempfile.TemporaryDirectory() as made:
        for title, scenes in (
            (f"Development: {2 * MADE_IMAGES} made pairs", make_scenes(vision, Path(made), MADE_IMAGES)),
            ("Development: eight pairs of homogr", [vision / name for name in PLANES]),
        ):
            detectors = choose_detectors([EvaluatedDetectorKind.ONNX], list(weights.values()))
            found = evaluate_homography(find_scenes(scenes), detectors)
            rows = [
                (name, nms_px, *(mean(found.of(detector.name), f"{each}_nms{nms_px}") for each in MEASURES.values()))
                for nms_px in MATCHING_NMS_PX
                for name, detector in zip(weights, detectors, strict=True)
            ]
            report.table(title, columns, rows)
    report.write()


def code_rows(folder: Path, arms: list[str]) -> Iterator[tuple]:
    for arm in arms:
        with watched(folder, arm).open(encoding="utf-8") as file:
            for name, step, other, same, stuck, own, loss in csv.reader(file):
                yield name, int(step), float(other), float(same), int(stuck), float(own), float(loss)


if __name__ == "__main__":
    main()
