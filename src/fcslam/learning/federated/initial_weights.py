"""The weights that federated training starts from."""

from collections.abc import Sequence
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from fcslam.errors import InputError
from fcslam.features.detector import GreyImage, network_file
from fcslam.learning.arrays import write_arrays
from fcslam.learning.checkpoint import read_checkpoint
from fcslam.learning.federated.networks import network_to_weights, weights_to_network, weights_version
from fcslam.learning.federated.onnx_weights import SUFFIX, read_onnx_weights, with_batch_statistics
from fcslam.learning.federated.public_images import statistics_images
from fcslam.learning.settings import Encoder, TrainingSettings
from fcslam.learning.stages import StageCallback, train_on_shapes
from fcslam.learning.trainer import ExecutionOptions
from fcslam.untrusted import read_arrays

GROUPS: Final = ("best/", "average/")
"""Prefixes of the trained weights in checkpoints of federated and of central training."""


def prepare_initial_weights(
    start: Path | None,
    folder: Path,
    settings: TrainingSettings,
    options: ExecutionOptions,
    on_progress: StageCallback,
    public: Sequence[GreyImage] = (),
) -> dict[str, NDArray[np.float32]]:
    """Weights of a checkpoint or an exported detector, or of a detector trained on synthetic shapes.

    An exported detector has no batch statistics. They are measured once, on public images or on shapes, and kept in
    ``folder``, so that other public images later do not change where the run started. ``start`` is a checkpoint, an
    ONNX file, or the name of a network that comes with fcslam; None to train on synthetic shapes. The server may read
    the ``public`` images.
    """
    if start is None:
        return network_to_weights(train_on_shapes(folder / "shapes", settings, options, on_progress))
    start, encoder = network_file(start), settings.encoder
    weights = read_detector_weights(start, encoder)
    if start.suffix != SUFFIX:
        return weights
    kept = folder / f"start-{weights_version(weights, encoder)}.npz"
    try:
        if not kept.exists():
            write_arrays(kept, with_batch_statistics(weights, encoder, statistics_images(public)))
        return network_to_weights(weights_to_network(read_arrays(kept), encoder))
    except OSError as error:
        raise InputError(f"{kept}: cannot be used ({error}); free disk space and run the same command again") from error
    except (ValueError, InputError) as error:
        raise InputError(f"{kept}: is broken ({error}); remove it") from error


def read_detector_weights(path: Path, encoder: Encoder) -> dict[str, NDArray[np.float32]]:
    """The weights in a checkpoint of federated or central training, or in an exported detector's ONNX file."""
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
    raise InputError(f"{path}: holds no weights of a detector")
