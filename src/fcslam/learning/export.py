"""Exports a trained network to ONNX.

Input `image` float32 (1, 1, H, W), grey in [0, 1], H and W any multiples of 8. Outputs `scores` float32 (1, H, W) and
`logits` float32 (1, 256, H/8, W/8), cell (r, c) centred at the pixel (8 c + 3.5, 8 r + 3.5). Metadata: `fcslam_format`,
and `fcslam_version`, which differs for other weights; every descriptor carries it.
"""

import contextlib
import hashlib
import io
import logging
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

import torch
from torch import Tensor, nn

from fcslam.errors import writing
from fcslam.features.detector import NETWORK_FORMAT
from fcslam.features.network_check import TRIAL_SHAPE
from fcslam.learning.network import KeypointNetwork
from fcslam.storage.files import write_file

OPSET: Final = 17


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
    """Write the file, in float32."""
    import onnx

    ready = ExportedNetwork(network).cpu().eval()
    content = io.BytesIO()
    sides = {2: "height", 3: "width"}
    with _quietly():
        torch.onnx.export(
            ready,
            (torch.rand(1, 1, *TRIAL_SHAPE),),
            content,
            input_names=["image"],
            output_names=["scores", "logits"],
            dynamic_axes={"image": sides, "scores": {1: "height", 2: "width"}, "logits": {2: "rows", 3: "columns"}},
            opset_version=OPSET,
            dynamo=False,
        )
    _write(onnx.load_from_string(content.getvalue()), detector_version(network), path)


def _write(graph: Any, version: str, path: Path) -> None:
    """Add the metadata to a graph and write it atomically."""
    import onnx

    del graph.metadata_props[:]
    for key, value in (("fcslam_format", NETWORK_FORMAT), ("fcslam_version", version)):
        graph.metadata_props.add(key=key, value=value)
    onnx.checker.check_model(graph)
    with writing(path, "free disk space or choose another folder"):
        write_file(path, graph.SerializeToString(deterministic=True))


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
