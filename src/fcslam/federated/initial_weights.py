"""What a fleet begins from, and what its detectors are judged by."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Final

import numpy as np
import torch
from numpy.typing import NDArray

from fcslam.errors import OutputError, TrainingError
from fcslam.features.detector import GreyImage
from fcslam.federated.codec import network_to_weights, version_maker, weights_to_network
from fcslam.federated.coordinator import Evaluator
from fcslam.federated.onnx_weights import SUFFIX, read_onnx_weights, with_batch_statistics
from fcslam.federated.settings import FederatedSettings
from fcslam.federated.weights import Weights
from fcslam.learning.arrays import read_arrays, write_arrays
from fcslam.learning.checkpoint import read_checkpoint
from fcslam.learning.export import CALIBRATION_IMAGES
from fcslam.learning.images import find_images, is_usable, read_image
from fcslam.learning.labels import Labels
from fcslam.learning.pairs import TrainingExample
from fcslam.learning.settings import Encoder
from fcslam.learning.stages import StageCallback, SyntheticShapes, train_on_shapes
from fcslam.learning.trainer import ExecutionOptions, validation_pairs
from fcslam.learning.validation import validate

GROUPS: Final = ("best/", "average/")
"""What the weights worth having are called in a checkpoint of `fcslam federate`, and of `fcslam train`."""


def prepare_initial_weights(
    start: Path | None,
    folder: Path,
    settings: FederatedSettings,
    pace: ExecutionOptions,
    watch: StageCallback,
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
        return network_to_weights(train_on_shapes(folder / "shapes", settings.training, pace, watch))
    encoder = settings.training.encoder
    weights = read_detector_weights(start, encoder)
    if start.suffix != SUFFIX:
        return weights
    kept = folder / f"start-{version_maker(encoder)(weights)}.npz"
    try:
        if not kept.exists():
            write_arrays(kept, with_batch_statistics(weights, encoder, calibration_images(public)))
        return network_to_weights(weights_to_network(read_arrays(kept), encoder))
    except OSError as error:
        raise OutputError(f"{kept}: cannot be used ({error}); make room and run the same command again") from error
    except (ValueError, TrainingError) as error:
        raise TrainingError(f"{kept}: is broken ({error}); take it away") from error


def read_detector_weights(path: Path, encoder: Encoder) -> dict[str, NDArray[np.float32]]:
    """The weights in a checkpoint of federated or central training, or in a released detector's ONNX file.

    Raises:
        TrainingError: it is none of these, or of another network.
    """
    if path.suffix == SUFFIX:
        return read_onnx_weights(path, encoder)
    tensors = read_checkpoint(path).tensors
    for group in GROUPS:
        arrays = {
            name.removeprefix(group): tensor.numpy()
            for name, tensor in tensors.items()
            if name.startswith(group) and tensor.is_floating_point()
        }
        if arrays:
            return network_to_weights(weights_to_network(arrays, encoder))
    raise TrainingError(f"{path}: holds no weights of a detector")


def read_public_images(roots: Sequence[Path]) -> list[GreyImage]:
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


def public_evaluator(images: Sequence[GreyImage], encoder: Encoder, device: str) -> Evaluator | None:
    """Figures of weights on pairs of views of these images, always the same; None without images."""
    if not images:
        return None
    unlabelled = Labels(np.zeros((0, 2), np.float32), np.zeros(0, np.float32))
    pairs = validation_pairs([TrainingExample(image, unlabelled) for image in images])

    def judge(weights: Weights) -> Mapping[str, float]:
        return validate(weights_to_network(weights, encoder).to(device), pairs, torch.device(device), shifts=False)

    return judge


def calibration_images(public: Sequence[GreyImage]) -> list[GreyImage]:
    """Images that stand for all: public ones, or synthetic shapes."""
    if public:
        return list(public[:: max(len(public) // CALIBRATION_IMAGES, 1)])[:CALIBRATION_IMAGES]
    return [example.image for example in SyntheticShapes(2, CALIBRATION_IMAGES)[:]]
