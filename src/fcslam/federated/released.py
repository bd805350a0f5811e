"""A released detector as something to train on from: its ONNX file read back as weights."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from fcslam.errors import TrainingError
from fcslam.federated.network import network_of, weights_of
from fcslam.learning.network import KeypointNetwork
from fcslam.learning.settings import Encoder

SUFFIX: Final = ".onnx"
VARIANCE: Final = 1.0 - 1e-5
"""With it batch normalisation, which adds 1e-5, changes nothing."""


def read_released(path: Path, encoder: Encoder) -> dict[str, NDArray[np.float32]]:
    """Weights of a network that gives what the float32 file gives.

    Exporting folded each batch normalisation into the convolution before it. Read back, it holds the shift alone:
    another network of the same function, which can be trained on.

    Raises:
        TrainingError: the file is no detector in float32, or of another encoder.
    """
    import onnx

    try:
        graph = onnx.load(str(path)).graph
    except Exception as error:  # of protobuf, of the system, of onnx
        raise TrainingError(f"{path}: is no ONNX file ({error})") from error
    weights = weights_of(KeypointNetwork(encoder))
    arrays = {array.name: np.array(onnx.numpy_helper.to_array(array)) for array in graph.initializer}
    given: dict[str, NDArray[Any]] = {}
    for node in graph.node:
        found = [arrays[name] for name in node.input[1:] if name in arrays]
        module = _module(node.name)
        if node.op_type == "Conv" and found and f"{module}.weight" in weights:
            given |= _unfolded(module, found[0], found[1:], weights)
    missing = sorted(name for name in weights if name not in given)
    if missing:
        raise TrainingError(f"{path}: holds no {missing[0]} of a {encoder} detector in float32")
    # A network of the right names and shapes, and finite, or refused.
    return weights_of(network_of({name: given[name] for name in weights}, encoder))


def _module(node: str) -> str:
    """What a convolution is called in the network: `/network/body/joint/joint.0/joint.0.0/Conv` is `body.joint.0.0`."""
    parts = node.split("/")
    return ".".join(parts[2:3] + parts[3:-1][-1:])


def _unfolded(
    module: str, kernel: NDArray[Any], bias: list[NDArray[Any]], weights: Mapping[str, NDArray[np.float32]]
) -> dict[str, NDArray[Any]]:
    """A convolution of the file as the arrays of the convolution and of the normalisation after it."""
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
        f"{norm}.running_var": VARIANCE * ones,
    }
