"""Exports a trained network to ONNX: in float32, and in int8 for processors without a GPU.

Input `image` float32 (1, 1, H, W), grey in [0, 1], H and W any multiples of 8. Outputs `scores` float32 (1, H, W) and
`logits` float32 (1, 256, H/8, W/8), cell (r, c) centred at the pixel (8 c + 3.5, 8 r + 3.5). Metadata: `fcslam_format`,
and `fcslam_version`, which differs for other weights; every descriptor carries it.
"""

import contextlib
import hashlib
import io
import logging
import tempfile
import warnings
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from torch import Tensor, nn

from fcslam.errors import OutputError
from fcslam.features.dense import CELL_PX
from fcslam.features.detector import NETWORK_FORMAT, GreyImage
from fcslam.features.onnx_runtime import load_onnx_runtime
from fcslam.learning.network import KeypointNetwork
from fcslam.storage.files import write_file

OPSET: Final = 17
CALIBRATION_IMAGES: Final = 64
FEWEST_INPUTS: Final = 8
"""Convolutions with fewer input channels than this are faster in float32 than in int8."""
TRACED_SIZE: Final = (240, 320)
"""Height and width of the image with which the network is traced [px]; the file takes other sizes too."""


class ExportedNetwork(nn.Module):
    """A network whose outputs are those of the file."""

    def __init__(self, network: KeypointNetwork) -> None:
        super().__init__()
        self.network = network

    def forward(self, image: Tensor) -> tuple[Tensor, Tensor]:
        """``scores`` and ``logits``."""
        maps = self.network(image)
        return self.network.scores(maps), maps.code_logits


def detector_version(network: KeypointNetwork) -> str:
    """The version of a detector with exactly these weights, such as `light-0a1b2c3d4e5f`."""
    digest = hashlib.sha256()
    for name, tensor in sorted(network.state_dict().items()):
        digest.update(name.encode())
        digest.update(tensor.detach().cpu().numpy().tobytes())
    return f"{network.encoder}-{digest.hexdigest()[:12]}"


def export_onnx(network: KeypointNetwork, path: Path) -> None:
    """Write the float32 file.

    Raises:
        OutputError: the file cannot be written.
    """
    import onnx

    ready = ExportedNetwork(network).cpu().eval()
    content = io.BytesIO()
    sides = {2: "height", 3: "width"}
    with _quietly():
        torch.onnx.export(
            ready,
            (torch.rand(1, 1, *TRACED_SIZE),),
            content,
            input_names=["image"],
            output_names=["scores", "logits"],
            dynamic_axes={"image": sides, "scores": {1: "height", 2: "width"}, "logits": {2: "rows", 3: "columns"}},
            opset_version=OPSET,
            dynamo=False,
        )
    _write(onnx.load_from_string(content.getvalue()), detector_version(network), path)


def quantise_onnx(source: Path, path: Path, images: Sequence[GreyImage]) -> None:
    """Write the int8 file of a float32 file.

    The last convolutions stay in float32, because their outputs are compared with one another. So do convolutions with
    so few inputs that int8 would slow them down.

    Args:
        source: the float32 file.
        path: the int8 file.
        images: determine the ranges of the activations.

    Raises:
        OutputError: the file cannot be written.
    """
    import onnx

    load_onnx_runtime()
    from onnxruntime.quantization import QuantFormat, QuantType, quantize_static

    graph = onnx.load(str(source))
    version = next(entry.value for entry in graph.metadata_props if entry.key == "fcslam_version")
    with tempfile.TemporaryDirectory() as folder, _quietly():
        quantize_static(
            graph,
            f"{folder}/{path.name}",
            _Calibration(images[:CALIBRATION_IMAGES]),
            quant_format=QuantFormat.QDQ,
            per_channel=True,
            activation_type=QuantType.QUInt8,
            weight_type=QuantType.QInt8,
            op_types_to_quantize=["Conv"],
            nodes_to_exclude=_left_in_float(graph),
        )
        quantised = onnx.load(f"{folder}/{path.name}")
    _write(quantised, f"{version}-int8", path)


class _Calibration:
    """Gives images to the quantiser, one after another."""

    def __init__(self, images: Sequence[GreyImage]) -> None:
        self._images = iter(images)

    def get_next(self) -> dict[str, Any] | None:
        """The next input, or None at the end."""
        image = next(self._images, None)
        if image is None:
            return None
        height, width = (side // CELL_PX * CELL_PX for side in image.shape)
        return {"image": image[None, None, :height, :width].astype(np.float32) / np.float32(255.0)}


def _left_in_float(graph: Any) -> list[str]:
    """Names of the convolutions that no other follows, of those with few inputs, and of those with fixed kernels."""
    inputs = {array.name: array.dims[1] for array in graph.graph.initializer if len(array.dims) == 4}
    consumers: dict[str, list[Any]] = {}
    for node in graph.graph.node:
        for name in node.input:
            consumers.setdefault(name, []).append(node)

    def leads_on(node: Any) -> bool:
        return any(
            each.op_type == "Conv" or leads_on(each) for output in node.output for each in consumers.get(output, [])
        )

    convolutions = [node for node in graph.graph.node if node.op_type == "Conv"]
    # A kernel that is fixed, and no weight, is a constant in the graph and not among the initialisers.
    return [node.name for node in convolutions if not leads_on(node) or inputs.get(node.input[1], 0) < FEWEST_INPUTS]


def _write(graph: Any, version: str, path: Path) -> None:
    """Add the metadata to a graph and write it atomically."""
    import onnx

    del graph.metadata_props[:]
    for key, value in (("fcslam_format", NETWORK_FORMAT), ("fcslam_version", version)):
        graph.metadata_props.add(key=key, value=value)
    onnx.checker.check_model(graph)
    try:
        write_file(path, graph.SerializeToString(deterministic=True))
    except OSError as error:
        raise OutputError(f"{path}: cannot be written ({error}); free disk space or choose another folder") from error


@contextlib.contextmanager
def _quietly() -> Iterator[None]:
    """Suppress the exporters' deprecation warnings."""
    level = logging.root.manager.disable
    logging.disable(logging.WARNING)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        logging.disable(level)
