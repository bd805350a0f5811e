"""What a fleet begins from, and what its detectors are judged by."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Final

import numpy as np
import torch
from numpy.typing import NDArray

from fcslam.errors import OutputError, TrainingError
from fcslam.features.detector import GreyImage
from fcslam.federated.network import network_of, version_maker, weights_of
from fcslam.federated.released import SUFFIX, normalised, read_released
from fcslam.federated.rounds import Judge
from fcslam.federated.settings import FederatedSettings
from fcslam.federated.weights import Weights
from fcslam.learning.arrays import read_arrays, write_arrays
from fcslam.learning.checkpoint import read_checkpoint
from fcslam.learning.export import CALIBRATION_IMAGES
from fcslam.learning.images import find_images, is_usable, read_image
from fcslam.learning.labels import Labels
from fcslam.learning.monitor import validate
from fcslam.learning.pairs import Example
from fcslam.learning.settings import Encoder
from fcslam.learning.stages import Shapes, Watch, train_on_shapes
from fcslam.learning.trainer import Pace, validation_pairs

GROUPS: Final = ("best/", "average/")
"""What the weights worth having are called in a checkpoint of `fcslam federate`, and of `fcslam train`."""


def first_weights(
    start: Path | None,
    folder: Path,
    settings: FederatedSettings,
    pace: Pace,
    watch: Watch,
    public: Sequence[GreyImage] = (),
) -> dict[str, NDArray[np.float32]]:
    """Weights of a checkpoint or a released detector; without one, of a detector trained on shapes in ``folder``.

    A released one is normalised by ``public`` images, or by shapes without any, once: what came of it is kept in
    ``folder``, so that other images there do not make it another start.

    Raises:
        TrainingError: ``start`` is neither or of another network, or ``folder`` holds another run or a broken file.
        OutputError: something cannot be written.
    """
    if start is None:
        return weights_of(train_on_shapes(folder / "shapes", settings.training, pace, watch))
    encoder = settings.training.encoder
    weights = read_weights(start, encoder)
    if start.suffix != SUFFIX:
        return weights
    kept = folder / f"start-{version_maker(encoder)(weights)}.npz"
    try:
        if not kept.exists():
            write_arrays(kept, normalised(weights, encoder, calibration_images(public)))
        return weights_of(network_of(read_arrays(kept), encoder))
    except OSError as error:
        raise OutputError(f"{kept}: cannot be used ({error}); make room and run the same command again") from error
    except (ValueError, TrainingError) as error:
        raise TrainingError(f"{kept}: is broken ({error}); take it away") from error


def read_weights(path: Path, encoder: Encoder) -> dict[str, NDArray[np.float32]]:
    """The weights in a checkpoint of federated or central training, or in a released detector's ONNX file.

    Raises:
        TrainingError: it is none of these, or of another network.
    """
    if path.suffix == SUFFIX:
        return read_released(path, encoder)
    tensors = read_checkpoint(path).tensors
    for group in GROUPS:
        arrays = {
            name.removeprefix(group): tensor.numpy()
            for name, tensor in tensors.items()
            if name.startswith(group) and tensor.is_floating_point()
        }
        if arrays:
            return weights_of(network_of(arrays, encoder))
    raise TrainingError(f"{path}: holds no weights of a detector")


def public_images(roots: Sequence[Path]) -> list[GreyImage]:
    """Usable images below the folders; none without folders.

    Raises:
        TrainingError: a folder is none, or holds no usable image.
    """
    if not roots:
        return []
    images = [image for file in find_images(roots) if (image := read_image(file.path)) is not None]
    usable = [image for image in images if is_usable(image)]
    if not usable:
        raise TrainingError(f"{roots[0]}: no image there is large and rich enough to judge detectors by")
    return usable


def judge_by(images: Sequence[GreyImage], encoder: Encoder, device: str) -> Judge | None:
    """Figures of weights on pairs of views of these images, always the same; None without images."""
    if not images:
        return None
    unlabelled = Labels(np.zeros((0, 2), np.float32), np.zeros(0, np.float32))
    pairs = validation_pairs([Example(image, unlabelled) for image in images])

    def judge(weights: Weights) -> Mapping[str, float]:
        return validate(network_of(weights, encoder).to(device), pairs, torch.device(device), shifts=False)

    return judge


def calibration_images(public: Sequence[GreyImage]) -> list[GreyImage]:
    """Images that stand for all: public ones, or synthetic shapes."""
    if public:
        return list(public[:: max(len(public) // CALIBRATION_IMAGES, 1)])[:CALIBRATION_IMAGES]
    return [example.image for example in Shapes(2, CALIBRATION_IMAGES)[:]]
