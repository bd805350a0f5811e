"""From a folder of images to a trained network: labels and training. Both can be resumed.

Without a teacher, the network from which training starts labels the images by homographic adaptation, together with
Harris's measure. With a teacher, the teacher's keypoints replace those of this network, and its descriptors determine
the wanted bits.
"""

import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Final

import numpy as np
import torch

from fcslam.errors import InputError
from fcslam.features.dense import CELL_PX
from fcslam.features.detector import GreyImage, OnnxConfig
from fcslam.learning.artifacts import Curve, Panel, TrainingReport
from fcslam.learning.export import detector_version
from fcslam.learning.images import ImageFile, find_images, is_held_out, is_usable, read_image
from fcslam.learning.labels import (
    MOST_POINTS,
    Labels,
    Response,
    Teacher,
    adapt,
    fuse_keypoints,
    harris,
    peaks,
    read_labels,
    read_teacher,
    write_labels,
)
from fcslam.learning.network import KeypointNetwork
from fcslam.learning.objective import TeacherBits, teacher_bits
from fcslam.learning.pairs import TrainingExample
from fcslam.learning.settings import TrainingSettings
from fcslam.learning.trainer import PROGRESS_FILE, ExecutionOptions, ProgressCallback, TrainingRun, read_curves

StageCallback = Callable[[str, int, int, Mapping[str, float], tuple[str, ...]], None]
"""Called with the name of a stage and its progress, as ``ProgressCallback``."""


FoundImages = tuple[Sequence[tuple[ImageFile, GreyImage]], int]
"""Usable images, and the number of files that are not images, too small, or have too few corners."""


@dataclass(frozen=True, slots=True)
class TrainingImages:
    """The usable images with their labels."""

    train: list[TrainingExample]
    held_out: list[TrainingExample]
    """For validation; if no image is held out, the first training image."""
    skipped: int
    """Number of files that are not images, too small, or have too few corners."""

    @property
    def are_held_out(self) -> bool:
        """Whether the images for validation are not trained on."""
        return self.held_out[0] is not self.train[0]

    def checksum(self) -> int:
        """Checksum of all that training reads, so that no checkpoint of other images is taken for one of these."""
        key = 0
        for example in (*self.train, *self.held_out):
            key = zlib.crc32(example.image.tobytes(), zlib.crc32(example.labels.keypoints.tobytes(), key))
            if example.teacher is not None:
                key = zlib.crc32(example.teacher.descriptors.tobytes(), key)
        return key


def train_detector(
    roots: Sequence[Path],
    folder: Path,
    settings: TrainingSettings,
    options: ExecutionOptions,
    teacher: Path | None,
    on_progress: StageCallback,
    start: KeypointNetwork | None = None,
) -> tuple[KeypointNetwork, TrainingImages]:
    """Train on the images below ``roots``; returns the trained network and the images.

    ``folder`` gets all files of the run; a run in it is continued. ``teacher``: folder of a teacher's files, if there
    is one. ``start``: trained network from which training starts; None to start anew.
    """
    own = folder.resolve()
    found = read_images([file for file in find_images(roots) if not file.path.resolve().is_relative_to(own)])
    labeller = None if start is None else keypoint_response(start.to(options.device), torch.device(options.device))
    images = label_images(found, folder / "labels", settings, labeller, teacher, partial(on_progress, "labels"))
    key, state = images.checksum(), None
    if start is not None:
        key, state = zlib.crc32(detector_version(start).encode(), key), start.state_dict()
    run = TrainingRun(settings, folder / "joint", options, state, key)
    bits = _teacher_bits(images.train, settings.seed)
    return run.train(images.train, images.held_out, bits, partial(on_progress, "joint")), images


def read_images(files: Sequence[ImageFile]) -> FoundImages:
    """Read the images that can be trained on."""
    read = ((file, read_image(file.path)) for file in files)
    found = [(file, image) for file, image in read if image is not None and is_usable(image)]
    train = sum(not is_held_out(file.name) for file, _ in found)
    if train < 2:
        raise InputError(
            f"only {train} of {len(files)} image files can be trained on: the others are not images, smaller than "
            "96 px or have too few corners; give more images"
        )
    return found, len(files) - len(found)


def label_images(
    found: FoundImages,
    cache: Path,
    settings: TrainingSettings,
    labeller: Callable[[GreyImage], Response] | None,
    teacher: Path | None = None,
    on_progress: ProgressCallback = lambda *_: None,
) -> TrainingImages:
    """Label images that have no labels in the folder ``cache`` yet.

    ``labeller`` gives the response by which images are labelled, beside Harris's measure; None for that alone.
    ``teacher``: folder of a teacher's files, whose keypoints replace those of the labeller; None without a teacher.
    """
    train: list[TrainingExample] = []
    held_out: list[TrainingExample] = []
    sizes: set[int] = set()
    images, skipped = found
    for index, (file, image) in enumerate(images):
        taught = None
        if teacher is not None:
            taught = read_teacher(teacher / f"{file.name}.npz")
            sizes.add(taught.descriptors.shape[1])
            if len(sizes) > 1:
                raise InputError(
                    f"{teacher / file.name}.npz: has descriptors of another size than the files before "
                    f"({' and '.join(map(str, sorted(sizes)))}); make all files with one teacher"
                )
        labels = _labels(image, cache / f"{file.name}.state", settings, labeller, taught)
        (held_out if is_held_out(file.name) else train).append(TrainingExample(image, labels, taught))
        on_progress(index + 1, len(images), {}, ())
    return TrainingImages(train, held_out or train[:1], skipped)


def _labels(
    image: GreyImage,
    place: Path,
    settings: TrainingSettings,
    detector: Callable[[GreyImage], Response] | None,
    teacher: Teacher | None,
) -> Labels:
    """Labels of an image, from the cache if pixels, teacher and settings are those that they were made with.

    A network that labels is not compared: a robot keeps the labels of the first one.
    """
    pixels = zlib.crc32(image.tobytes())
    key = zlib.crc32(f"{settings.seed} {settings.label_copies}".encode(), pixels)
    key = key if teacher is None else zlib.crc32(teacher.keypoints.tobytes(), key)
    known = read_labels(place, key)
    if known is not None:
        return known
    rng = np.random.default_rng([settings.seed, pixels])
    corners = peaks(adapt(harris, image, settings.label_copies, rng), OnnxConfig().nms_px, MOST_POINTS)
    if teacher is not None:
        others = teacher.keypoints
    elif detector is not None:
        others = peaks(adapt(detector, image, settings.label_copies, rng), OnnxConfig().nms_px, MOST_POINTS)
    else:
        others = corners
    labels = fuse_keypoints(corners, others)
    write_labels(place, labels, key)
    return labels


def _teacher_bits(examples: Sequence[TrainingExample], seed: int) -> TeacherBits | None:
    """The projection of a teacher's descriptors to bits, fitted to 32 descriptors of each image."""
    taught = [example.teacher.descriptors for example in examples if example.teacher is not None]
    if not taught:
        return None
    some = [descriptors[:: max(len(descriptors) // 32, 1)] for descriptors in taught]
    return teacher_bits(torch.from_numpy(np.concatenate(some).astype(np.float32)), seed)


def keypoint_response(network: KeypointNetwork, device: torch.device) -> Callable[[GreyImage], Response]:
    """The network's keypoint response, shape (height, width), as a function of an image."""

    @torch.inference_mode()
    def detector(image: GreyImage) -> Response:
        height, width = (side // CELL_PX * CELL_PX for side in image.shape)
        batch = torch.from_numpy(image[:height, :width]).to(device)[None, None].float() / 255.0
        response = np.zeros(image.shape, np.float32)
        response[:height, :width] = network.scores(network(batch))[0].cpu().numpy()
        return response

    response_of: Callable[[GreyImage], Response] = detector
    return response_of


SHOWN_METRICS: Final = {
    "repeatability": "keypoints found again within 3 px",
    "mma_3px": "matches within 3 px, by bits",
    "bit_bias": "distance of a bit's mean from a half",
    "code_spread_bits": "bits between codes of different points",
}


def training_report(folder: Path, images: TrainingImages, teacher: Path | None) -> TrainingReport:
    """The report of a run in a folder, for its card and picture."""
    curves = read_curves(folder / "joint" / PROGRESS_FILE)
    held_out = f"{len(images.held_out)} others were held out" if images.are_held_out else "none was held out"
    facts = [
        f"Trained on {len(images.train)} images; {held_out}, {images.skipped} left out.",
        f"Teacher: {'none' if teacher is None else f'keypoints and descriptors in {teacher.name}'}.",
    ]
    judged = "held-out images" if images.are_held_out else "an image that was trained on"

    def shown(*names: str) -> dict[str, Curve]:
        return {name.replace("_", " "): curves[name] for name in names if name in curves}

    return TrainingReport(
        facts,
        f"on pairs of views of {judged}, 320 x 240, warped and lit at random",
        {text: curves[name][1][-1] for name, text in SHOWN_METRICS.items() if name in curves},
        [
            Panel("losses", shown("detector", "contrastive", "triplet", "distillation")),
            Panel("on held-out images", shown("repeatability", "mma_3px"), are_shares=True),
            Panel("bits between codes of different points", shown("code_spread_bits")),
        ],
        "step",
    )
