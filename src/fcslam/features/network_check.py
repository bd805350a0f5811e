"""Checks of a network from outside before it is used: its protobuf first, then a run in a process with limits.

    python -m fcslam.features.network_check FILE

is that process. ONNX Runtime evaluates constant parts of a graph while it loads it, so a small file can fill memory.
"""

import resource
import sys
from functools import cache
from math import prod
from pathlib import Path
from typing import Any, Final

from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from google.protobuf.message import DecodeError

from fcslam.config import one_line
from fcslam.errors import FeatureError
from fcslam.processes import run_module
from fcslam.records import MOST_NETWORK_BYTES
from fcslam.untrusted import read_bytes

MOST_NODES: Final = 2000
MOST_ATTRIBUTES: Final = 20 * MOST_NODES
MOST_ELEMENTS: Final = MOST_NETWORK_BYTES // 4
"""Numbers in one array of weights."""
TRIAL_MEMORY_BYTES: Final = 400_000_000
"""Memory of a run on an image of ``TRIAL_SHAPE``; the paper's network needs 60 MB."""
TRIAL_CPU_S: Final = 10
TRIAL_SHAPE: Final = (240, 320)
OPERATORS: Final = frozenset(
    [
        "Add",
        "Cast",
        "Concat",
        "Constant",
        "ConstantOfShape",
        "Conv",
        "DepthToSpace",
        "Div",
        "Equal",
        "Exp",
        "Gather",
        "Identity",
        "If",
        "LogSoftmax",
        "MaxPool",
        "Mul",
        "Pad",
        "ReduceMean",
        "Relu",
        "Reshape",
        "Resize",
        "Shape",
        "Sigmoid",
        "Slice",
        "Softmax",
        "Sqrt",
        "Squeeze",
        "Sub",
        "Transpose",
        "Unsqueeze",
    ]
)
"""Operators of the exported networks; none repeats a part of the graph."""

_FIELDS: Final[dict[str, dict[str, tuple[int, str]]]] = {
    "Model": {"graph": (7, "Graph"), "functions": (25, "bytes")},
    "Graph": {"node": (1, "Node"), "initializer": (5, "Tensor"), "sparse_initializer": (15, "bytes")},
    "Node": {"op_type": (4, "bytes"), "attribute": (5, "Attribute"), "domain": (7, "bytes")},
    "Attribute": {
        "t": (5, "Tensor"),
        "g": (6, "Graph"),
        "tensors": (10, "Tensor"),
        "graphs": (11, "Graph"),
        "sparse_tensor": (22, "bytes"),
        "sparse_tensors": (23, "bytes"),
    },
    "Tensor": {"dims": (1, "int64"), "external_data": (13, "bytes"), "data_location": (14, "int64")},
}
"""The checked parts of onnx.proto (https://github.com/onnx/onnx/blob/main/onnx/onnx.proto), all read as repeated."""


def check_network(path: Path) -> None:
    """Check a network that somebody else may have made.

    Raises:
        FeatureError: it is not like the networks of this project, or takes too much memory or time.
    """
    try:
        content = read_bytes(path, most=MOST_NETWORK_BYTES)
        model = _model().FromString(content)
    except (OSError, DecodeError) as error:
        raise FeatureError(f"{path}: not an ONNX network ({error}); give weights of an fcslam detector") from error
    nodes, reason = 0, "it has functions" if model.functions else ""
    graphs = list(model.graph)
    while graphs and not reason:
        graph = graphs.pop()
        nodes += len(graph.node)
        if nodes > MOST_NODES or sum(len(node.attribute) for node in graph.node) > MOST_ATTRIBUTES:
            reason = f"more than {MOST_NODES} nodes or {MOST_ATTRIBUTES} attributes, the limits"
            break
        attributes = [attribute for node in graph.node for attribute in node.attribute]
        graphs += (inner for attribute in attributes for inner in (*attribute.g, *attribute.graphs))
        tensors = [*graph.initializer, *(t for attribute in attributes for t in (*attribute.t, *attribute.tensors))]
        reason = _reason(graph, attributes, tensors)
    if reason:
        raise FeatureError(
            f"{path}: differs from the networks of fcslam ({reason}); give weights of an fcslam detector"
        )
    _try(path)


def _reason(graph: Any, attributes: list[Any], tensors: list[Any]) -> str:
    """What a graph has that no exported network has; empty if nothing."""
    if graph.sparse_initializer or any(each.sparse_tensor or each.sparse_tensors for each in attributes):
        return "sparse arrays"
    for tensor in tensors:
        if tensor.external_data or any(tensor.data_location):
            return "arrays in other files"
        too_deep = len(tensor.dims) > 8  # before the product, which grows without end
        if too_deep or any(side < 0 for side in tensor.dims) or prod(tensor.dims) > MOST_ELEMENTS:
            return f"an array of more than {MOST_ELEMENTS} numbers, the limit"
    for node in graph.node:
        names = [name.decode(errors="replace") for name in node.op_type]
        if any(node.domain) or not set(names) <= OPERATORS:
            return f"the operator {' '.join(names)[:64]!r}"
    return ""


def _try(path: Path) -> None:
    try:
        code, refusal = run_module("fcslam.features.network_check", str(path), timeout_s=6.0 * TRIAL_CPU_S)
    except TimeoutError as error:
        raise FeatureError(
            f"{path}: the network takes more than {6 * TRIAL_CPU_S} s to run; give other weights"
        ) from error
    if code == 1 and refusal:
        raise FeatureError(refusal)
    if code:
        limits = f"{TRIAL_MEMORY_BYTES / 1e6:.0f} MB and {TRIAL_CPU_S} s"
        raise FeatureError(f"{path}: the network does not run within the limits of {limits}; give other weights")


@cache
def _model() -> Any:
    """The message class of a model, with the fields of ``_FIELDS`` only."""
    file = descriptor_pb2.FileDescriptorProto(name="fcslam_onnx_subset.proto", package="fcslam.onnx", syntax="proto2")
    plain = {"bytes": 12, "int64": 3}
    for name, fields in _FIELDS.items():
        message = file.message_type.add(name=name)
        for field, (number, kind) in fields.items():
            added = message.field.add(name=field, number=number, label=3, type=plain.get(kind, 11))
            if kind not in plain:
                added.type_name = f".fcslam.onnx.{kind}"
    pool = descriptor_pool.DescriptorPool()
    pool.Add(file)
    return message_factory.GetMessageClass(pool.FindMessageTypeByName("fcslam.onnx.Model"))


def _main(path: Path) -> int:
    """Load and run a network with limits of memory and time."""
    import numpy as np

    from fcslam.features.detector import OnnxConfig, OnnxDetector, load_onnx_runtime

    try:
        load_onnx_runtime()
    except FeatureError as error:
        sys.stdout.write(one_line(str(error)))
        return 1
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[0])
    most = pages * resource.getpagesize() + TRIAL_MEMORY_BYTES
    resource.setrlimit(resource.RLIMIT_AS, (most, most))
    resource.setrlimit(resource.RLIMIT_CPU, (TRIAL_CPU_S, TRIAL_CPU_S))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    try:
        OnnxDetector(OnnxConfig(weights=path)).infer(np.zeros(TRIAL_SHAPE, np.uint8))
    except FeatureError as error:
        sys.stdout.write(one_line(str(error)))
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(_main(Path(sys.argv[1])))
