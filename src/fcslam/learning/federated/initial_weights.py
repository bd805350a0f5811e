"""The weights that training starts from: those of a checkpoint, or of an exported detector's ONNX file."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from fcslam.errors import InputError, writing
from fcslam.features.dense import CELL_PX
from fcslam.features.detector import GreyImage, network_file
from fcslam.learning.federated.networks import network_to_weights, weights_to_network, weights_version
from fcslam.learning.federated.weights import BATCH_NORM_EPSILON, Weights
from fcslam.learning.network import KeypointNetwork
from fcslam.learning.settings import Encoder
from fcslam.learning.trainer import CHECKPOINT_FORMAT
from fcslam.storage.state_file import State, read_state, write_state

SUFFIX: Final = ".onnx"
GROUPS: Final = ("best", "average")
"""Trained weights in checkpoints of federated and of central training."""
MIN_DEVIATION: Final = 2.0**-8
"""Standard deviation assumed for a constant channel; its square must exceed ``BATCH_NORM_EPSILON``."""
STATISTICS_IMAGES: Final = 64


def prepare_initial_weights(
    start: Path | None, folder: Path, encoder: Encoder, images: Sequence[GreyImage] = ()
) -> dict[str, NDArray[np.float32]]:
    """Weights of a checkpoint or an exported detector.

    An exported detector has no batch statistics. They are measured once, on the images or on drawn ones, and kept in
    ``folder``, so that other images later do not change where the run started. ``start`` is a checkpoint, an ONNX file,
    or the name of a network that comes with fcslam; None for the one with this encoder.
    """
    start = network_file(start if start is not None or encoder == "light" else Path(encoder))
    weights = read_detector_weights(start, encoder)
    if start.suffix != SUFFIX:
        return weights
    kept, version = folder / "start.state", weights_version(weights, encoder)
    try:
        known = read_state(kept, version)
    except InputError:  # damaged, or of another start
        known = None
    if known is None:
        some = images[:: max(len(images) // STATISTICS_IMAGES, 1)][:STATISTICS_IMAGES]
        known = with_batch_statistics(weights, encoder, some or drawn_images())
        with writing(kept):
            folder.mkdir(parents=True, exist_ok=True)
            write_state(kept, version, known)
    return network_to_weights(weights_to_network(known, encoder))


def drawn_images() -> list[GreyImage]:
    """Rectangles that hide one another, with shades near that of a plain background, as of a wall."""
    rng, pictures = np.random.default_rng(2), []
    for _ in range(STATISTICS_IMAGES):
        level = int(rng.integers(20, 236))
        picture = np.full((240, 240), level, np.uint8)
        for x, y in rng.integers(0, 240, (40, 2)).tolist():
            shade = int(np.clip(level + rng.integers(-80, 81), 0, 255))
            width, height = (3.0 / rng.uniform(0.03, 1.0, 2)).astype(int).tolist()
            cv2.rectangle(picture, (x, y), (x + width, y + height), shade, -1)
        pictures.append(np.asarray(cv2.GaussianBlur(picture, (5, 5), 0), np.uint8))
    return pictures


def read_detector_weights(path: Path, encoder: Encoder) -> dict[str, NDArray[np.float32]]:
    """The weights in a checkpoint of federated or central training, or in an exported detector's ONNX file."""
    if path.suffix == SUFFIX:
        return read_onnx_weights(path, encoder)
    content = read_state(path, CHECKPOINT_FORMAT) or {}
    arrays: State = next((content[group] for group in GROUPS if group in content), {})
    floats = {name: array for name, array in arrays.items() if array.dtype == np.float32}
    if not floats:
        raise InputError(f"{path}: holds no weights of a detector")
    return network_to_weights(weights_to_network(floats, encoder))


def read_onnx_weights(path: Path, encoder: Encoder) -> dict[str, NDArray[np.float32]]:
    """Weights of a network that computes the same as a file in float32, whose weights may be stored in float16.

    The export folded each batch normalisation into the convolution before it. Read back, the normalisation only holds
    the shift, so the network computes the same function. Before training, call ``with_batch_statistics``.
    """
    import onnx

    try:
        graph = onnx.load(str(path)).graph
    except Exception as error:  # errors of protobuf, of the system and of onnx
        raise InputError(f"{path}: is not an ONNX file ({error})") from error
    weights = network_to_weights(KeypointNetwork(encoder))
    arrays = {array.name: np.array(onnx.numpy_helper.to_array(array)) for array in graph.initializer}
    for node in graph.node:
        if node.op_type == "Cast" and node.input[0] in arrays:  # stored in float16
            arrays[node.output[0]] = arrays[node.input[0]].astype(np.float32)
    given: dict[str, NDArray[Any]] = {}
    for node in graph.node:
        found = [arrays[name] for name in node.input[1:] if name in arrays]
        # `body.joint.0.0` is the network's name for `/network/body/joint/joint.0/joint.0.0/Conv`.
        parts = node.name.split("/")
        module = ".".join(parts[2:3] + parts[3:-1][-1:])
        if node.op_type == "Conv" and found and f"{module}.weight" in weights:
            given |= _unfold(module, found[0], found[1:], weights)
    missing = sorted(name for name in weights if name not in given)
    if missing:
        raise InputError(f"{path}: holds no {missing[0]} of a {encoder} detector in float32")
    # Through a network, which checks names, shapes and values.
    return network_to_weights(weights_to_network({name: given[name] for name in weights}, encoder))


def _unfold(
    module: str, kernel: NDArray[Any], bias: list[NDArray[Any]], weights: Mapping[str, NDArray[np.float32]]
) -> dict[str, NDArray[Any]]:
    """The arrays of a convolution of the file, and of the normalisation that was folded into it."""
    arrays = {f"{module}.weight": kernel}
    if not bias:
        return arrays
    if f"{module}.bias" in weights:
        return arrays | {f"{module}.bias": bias[0]}
    parent, _, index = module.rpartition(".")
    norm, ones = f"{parent}.{int(index) + 1}", np.ones_like(bias[0])
    return arrays | {
        f"{norm}.weight": ones,
        f"{norm}.bias": bias[0],
        f"{norm}.running_mean": np.zeros_like(ones),
        f"{norm}.running_var": (1.0 - BATCH_NORM_EPSILON) * ones,  # with which normalisation does not scale
    }


@torch.inference_mode()
def with_batch_statistics(
    weights: Weights, encoder: Encoder, images: Sequence[GreyImage]
) -> dict[str, NDArray[np.float32]]:
    """The weights of the same function, with batch statistics measured on images.

    Training normalises by the statistics of each batch. A network that was trained without normalisation would change
    its function in the first step. The more the images resemble those of a robot, the smaller is this change.
    """
    network = weights_to_network(weights, encoder)
    sums: dict[nn.Module, tuple[int, Tensor, Tensor]] = {}

    def add(norm: nn.Module, inputs: tuple[Tensor]) -> None:
        values = inputs[0].double()
        count, total, squares = sums.get(norm, (0, torch.zeros(()), torch.zeros(())))
        part = values.sum((0, 2, 3)), values.square().sum((0, 2, 3))
        sums[norm] = count + values[:, 0].numel(), total + part[0], squares + part[1]

    norms = {name: module for name, module in network.named_modules() if isinstance(module, nn.BatchNorm2d)}
    for norm in norms.values():
        norm.register_forward_pre_hook(add)
    for image in images:
        height, width = (side // CELL_PX * CELL_PX for side in image.shape)
        network(torch.from_numpy(image[:height, :width])[None, None].float() / 255.0)
    given = dict(weights)
    for name, norm in norms.items():
        count, total, squares = sums[norm]
        mean = total / count
        deviation = (squares / count - mean.square()).clamp(min=0.0).sqrt().clamp(min=MIN_DEVIATION)
        before = norm.weight.double() / (norm.running_var.double() + norm.eps).sqrt()
        arrays = {
            "weight": before * deviation,
            "bias": norm.bias.double() + before * (mean - norm.running_mean),
            "running_mean": mean,
            "running_var": deviation.square() - norm.eps,
        }
        given |= {f"{name}.{part}": tensor.detach().float().numpy() for part, tensor in arrays.items()}
    return given
