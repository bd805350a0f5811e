"""Use a detector of your own for camera images: a network in an ONNX file, with the inputs and outputs below.

    python examples/own_detector.py [FILE.onnx]

To map with it, set `robot.views.weights` to the file. This one knows contrast and random filters.
"""

import sys
from pathlib import Path

import numpy as np
import onnx
from onnx import TensorProto
from onnx.helper import make_graph, make_model, make_node, make_opsetid, make_tensor_value_info, set_model_props
from onnx.numpy_helper import from_array

from fcslam.features.detector import OnnxConfig, OnnxDetector

NODES = [
    make_node("Conv", ["image", "contrast"], ["difference"], pads=[1, 1, 1, 1]),
    make_node("Abs", ["difference"], ["strength"]),
    make_node("Squeeze", ["strength", "axis"], ["scores"]),  # (1, H, W), in [0, 1]
    make_node("Conv", ["image", "filters"], ["logits"], strides=[8, 8]),  # (1, 256, H / 8, W / 8); the signs are bits
]
FILTERS = np.random.default_rng(0).normal(size=(256, 1, 8, 8)).astype(np.float32)
CONTRAST = np.float32([[[[-1, -1, -1], [-1, 8, -1], [-1, -1, -1]]]]) / 8
WEIGHTS = {"contrast": CONTRAST, "filters": FILTERS - FILTERS.mean((2, 3), keepdims=True), "axis": np.array([1])}
SHAPES = {"image": [1, 1, "H", "W"], "scores": [1, "H", "W"], "logits": [1, 256, "h", "w"]}

if __name__ == "__main__":
    file = [*sys.argv, "own.onnx"][1]
    image, *outputs = (make_tensor_value_info(name, TensorProto.FLOAT, shape) for name, shape in SHAPES.items())
    graph = make_graph(NODES, "own", [image], outputs, [from_array(array, name) for name, array in WEIGHTS.items()])
    network = make_model(graph, opset_imports=[make_opsetid("", 17)], ir_version=8)
    set_model_props(network, {"fcslam_format": "1", "fcslam_version": "own-1"})  # a new version for new weights
    onnx.save(network, file)
    image = np.random.default_rng(1).integers(0, 255, (240, 320), "u1")
    features = OnnxDetector(OnnxConfig(weights=Path(file))).detect(image)
    print(f"{file}: {len(features.scores)} keypoints of {8 * features.descriptors.shape[1]} bits in an image of noise")
