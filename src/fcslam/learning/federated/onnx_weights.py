"""Reads the weights of an exported detector back from its ONNX file, so that training can continue from it."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from fcslam.errors import InputError
from fcslam.features.dense import CELL_PX
from fcslam.features.detector import GreyImage
from fcslam.learning.federated.networks import network_to_weights, weights_to_network
from fcslam.learning.federated.weights import Weights
from fcslam.learning.network import KeypointNetwork
from fcslam.learning.settings import Encoder

SUFFIX: Final = ".onnx"
UNIT_VARIANCE: Final = 1.0 - 1e-5
"""With this variance batch normalisation, which adds 1e-5 to it, does not scale."""
MIN_DEVIATION: Final = 2.0**-8
"""Standard deviation assumed for a constant channel; its square must exceed the 1e-5."""


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
        module = _module(node.name)
        if node.op_type == "Conv" and found and f"{module}.weight" in weights:
            given |= _unfold(module, found[0], found[1:], weights)
    missing = sorted(name for name in weights if name not in given)
    if missing:
        raise InputError(f"{path}: holds no {missing[0]} of a {encoder} detector in float32")
    # Through a network, which checks names, shapes and values.
    return network_to_weights(weights_to_network({name: given[name] for name in weights}, encoder))


def _module(node: str) -> str:
    """The network's name for a convolution: `body.joint.0.0` for `/network/body/joint/joint.0/joint.0.0/Conv`."""
    parts = node.split("/")
    return ".".join(parts[2:3] + parts[3:-1][-1:])


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
        f"{norm}.running_var": UNIT_VARIANCE * ones,
    }


def with_batch_statistics(
    weights: Weights, encoder: Encoder, images: Sequence[GreyImage]
) -> dict[str, NDArray[np.float32]]:
    """The weights of the same function, with batch statistics measured on images.

    Training normalises by the statistics of each batch. A network that was trained without normalisation would change
    its function in the first step. The more the images resemble those of a robot, the smaller is this change.
    """
    network = weights_to_network(weights, encoder)
    norms = {name: module for name, module in network.named_modules() if isinstance(module, nn.BatchNorm2d)}
    sums = _input_sums(norms, network, images)
    given = dict(weights)
    for name, norm in norms.items():
        count, total, squares = sums[name]
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


@torch.inference_mode()
def _input_sums(
    norms: Mapping[str, nn.BatchNorm2d], network: KeypointNetwork, images: Sequence[GreyImage]
) -> dict[str, tuple[int, Tensor, Tensor]]:
    """By normalisation: number of input values of a channel, their sums (C,) and the sums of their squares (C,)."""
    found: dict[str, tuple[int, Tensor, Tensor]] = {}

    def hook(name: str) -> Any:
        def add(_module: nn.Module, inputs: tuple[Tensor]) -> None:
            values = inputs[0].double()
            count, total, squares = found.get(name, (0, torch.zeros(()), torch.zeros(())))
            part = values.sum((0, 2, 3)), values.square().sum((0, 2, 3))
            found[name] = count + values[:, 0].numel(), total + part[0], squares + part[1]

        return add

    for name, norm in norms.items():
        norm.register_forward_pre_hook(hook(name))
    for image in images:
        height, width = (side // CELL_PX * CELL_PX for side in image.shape)
        network(torch.from_numpy(image[:height, :width])[None, None].float() / 255.0)
    return found
