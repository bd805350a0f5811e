"""From a folder of images to a trained network: shapes, labels, joint training. Each stage can be resumed.

Without a teacher, a detector labels the images by homographic adaptation, together with Harris's measure: the one from
which training starts, or one that first learns corners on synthetic shapes. With a teacher, the teacher's keypoints
replace those of this detector, and its descriptors determine the wanted bits.
"""

import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Final, overload

import numpy as np
import torch

from fcslam.errors import InputError, writing
from fcslam.features.dense import CELL_PX
from fcslam.features.detector import GreyImage
from fcslam.learning.artifacts import Curve, Panel, TrainingReport
from fcslam.learning.export import detector_version
from fcslam.learning.homographic_adaptation import Response, adapt, harris, peaks
from fcslam.learning.images import ImageFile, find_images, is_held_out, is_usable, read_image
from fcslam.learning.labels import MOST_POINTS, Labels, Teacher, fuse_keypoints, read_labels, read_teacher, write_labels
from fcslam.learning.network import KeypointNetwork
from fcslam.learning.objective import LossWeights, TeacherBits, teacher_bits
from fcslam.learning.pairs import TrainingExample
from fcslam.learning.settings import TrainingSettings
from fcslam.learning.synthetic_shapes import draw_shapes
from fcslam.learning.trainer import PROGRESS_FILE, ExecutionOptions, TrainingProgress, TrainingRun, read_curves

LABEL_NMS_PX: Final = 4.0
DESCRIPTORS_OF_AN_IMAGE: Final = 32
"""Descriptors of each image to which the projection of a teacher's descriptors is fitted."""
FEWEST_IMAGES: Final = 2
SHAPE_COUNT: Final = 1_000_000
"""Number of different synthetic shapes, more than any training draws."""
HELD_OUT_SHAPES: Final = 32
SHAPE_SIDE_PX: Final = 240
SHAPE_LOSSES: Final = LossWeights(triplet=0.0, contrastive=0.0, distillation=0.0, balance=0.0)
"""Only the keypoint maps are trained on shapes: descriptors would learn nothing useful there."""

StageCallback = Callable[[str, TrainingProgress], None]
"""Called with the name of a stage and its progress."""


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


class SyntheticShapes(Sequence[TrainingExample]):
    """Synthetic shapes; the same index always gives the same picture."""

    def __init__(self, first: int, count: int) -> None:
        self._first, self._count = first, count

    def __len__(self) -> int:
        return self._count

    @overload
    def __getitem__(self, index: int) -> TrainingExample: ...
    @overload
    def __getitem__(self, index: slice) -> Sequence[TrainingExample]: ...
    def __getitem__(self, index: int | slice) -> TrainingExample | Sequence[TrainingExample]:
        if isinstance(index, slice):
            return [self[position] for position in range(*index.indices(self._count))]
        rng = np.random.default_rng([self._first, index])
        return TrainingExample(*draw_shapes(SHAPE_SIDE_PX, SHAPE_SIDE_PX, rng))


def train_detector(
    roots: Sequence[Path],
    folder: Path,
    settings: TrainingSettings,
    options: ExecutionOptions,
    teacher: Path | None,
    on_progress: StageCallback,
    most_images: int | None = None,
    start: KeypointNetwork | None = None,
) -> tuple[KeypointNetwork, TrainingImages]:
    """Train on the images below ``roots``.

    Args:
        roots: folders of images.
        folder: for all files of the run; a run in it is continued.
        settings, options: of the run.
        teacher: folder of a teacher's files; None without a teacher.
        on_progress: called after every step.
        most_images: train on the first ones alone; None for all.
        start: trained network from which training starts; None to start anew.

    Returns:
        The trained network, and the images that it was trained on.
    """
    own = folder.resolve()
    files = [file for file in find_images(roots) if not file.path.resolve().is_relative_to(own)]
    _check_usable(files)
    first, device = start, torch.device(options.device)
    if first is None and teacher is None:
        first = train_on_shapes(folder / "shapes", settings, options, on_progress)
    detector = None if first is None or teacher is not None else keypoint_response(first.to(device), device)
    images = read_labelled_images(files, folder / "labels", settings, detector, teacher, on_progress, most_images)
    key = images.checksum()
    if start is not None:
        key = zlib.crc32(detector_version(start).encode(), key)
    state = None if first is None else first.state_dict()
    run = TrainingRun(settings, "joint", folder / "joint", options, state, key)
    return run.train(
        images.train,
        images.held_out,
        _teacher_bits(images.train, settings.seed),
        on_progress=partial(on_progress, "joint"),
    ), images


def read_labelled_images(
    files: Sequence[ImageFile],
    cache: Path,
    settings: TrainingSettings,
    detector: Callable[[GreyImage], Response] | None,
    teacher: Path | None,
    on_progress: StageCallback,
    most: int | None = None,
) -> TrainingImages:
    """Read images, and label those that have no labels in ``cache`` yet.

    Args:
        files: of the images.
        cache: folder of the labels.
        settings: of the run.
        detector: gives the response by which images are labelled, beside Harris's measure; None for that alone.
        teacher: folder of a teacher's files, whose keypoints replace the detector's; None without a teacher.
        on_progress: called after every image.
        most: usable images to train on; reading ends with the last of them. None for all.
    """
    train: list[TrainingExample] = []
    held_out: list[TrainingExample] = []
    skipped = 0
    sizes: set[int] = set()
    for index, file in enumerate(files):
        image = read_image(file.path)
        if image is not None and is_usable(image):
            teacher_of_image = None
            if teacher is not None:
                teacher_of_image = read_teacher(teacher / f"{file.name}.npz")
                sizes.add(teacher_of_image.descriptors.shape[1])
                if len(sizes) > 1:
                    raise InputError(
                        f"{teacher / file.name}.npz: has descriptors of another size than the files before "
                        f"({' and '.join(map(str, sorted(sizes)))}); make all files with one teacher"
                    )
            place = cache / f"{file.name}.npz"
            (held_out if is_held_out(file.name) else train).append(
                TrainingExample(image, _labels(image, place, settings, detector, teacher_of_image), teacher_of_image)
            )
        else:
            skipped += 1
        missing = len(files) if most is None else most - len(train)
        on_progress("labels", TrainingProgress(index + 1, min(index + 1 + missing, len(files)), {}))
        if len(train) == most:
            break
    if len(train) < FEWEST_IMAGES:
        raise _too_few(len(train), len(files))
    return TrainingImages(train, held_out or train[:1], skipped)


def _check_usable(files: Sequence[ImageFile]) -> None:
    """Look before the long work whether there are enough images."""
    usable = 0
    for file in files:
        image = read_image(file.path)
        usable += image is not None and is_usable(image) and not is_held_out(file.name)
        if usable >= FEWEST_IMAGES:
            return
    raise _too_few(usable, len(files))


def _too_few(usable: int, files: int) -> InputError:
    return InputError(
        f"only {usable} of {files} image files can be trained on: the others are not images, smaller than 96 px or "
        "have too few corners; give more images"
    )


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
    corners = peaks(adapt(harris, image, settings.label_copies, rng), LABEL_NMS_PX, MOST_POINTS)
    if teacher is not None:
        others = teacher.keypoints
    elif detector is not None:
        others = peaks(adapt(detector, image, settings.label_copies, rng), LABEL_NMS_PX, MOST_POINTS)
    else:
        others = corners
    labels = fuse_keypoints(corners, others)
    with writing(place):
        write_labels(place, labels, key)
    return labels


def train_on_shapes(
    folder: Path, settings: TrainingSettings, options: ExecutionOptions, on_progress: StageCallback
) -> KeypointNetwork:
    """Train a detector of the corners of synthetic shapes; its descriptors are not trained yet.

    ``folder`` is for the files of this stage, which is continued if it is in there.
    """
    shapes = settings.model_copy(update={"steps": settings.shape_steps})
    run = TrainingRun(shapes, "shapes", folder, options)
    return run.train(
        SyntheticShapes(0, SHAPE_COUNT),
        SyntheticShapes(1, HELD_OUT_SHAPES),
        weights=SHAPE_LOSSES,
        on_progress=partial(on_progress, "shapes"),
    )


def _teacher_bits(examples: Sequence[TrainingExample], seed: int) -> TeacherBits | None:
    """The projection of a teacher's descriptors to bits, fitted to some descriptors of each image."""
    taught = [example.teacher.descriptors for example in examples if example.teacher is not None]
    if not taught:
        return None
    some = [descriptors[:: max(len(descriptors) // DESCRIPTORS_OF_AN_IMAGE, 1)] for descriptors in taught]
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
    curves = read_curves(folder / "joint" / PROGRESS_FILE, "joint")
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
