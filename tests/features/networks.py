"""Tiny networks that keep the contract, or break it on purpose."""

import numpy as np
import pytest


def tiny_network(path, *, bits=256, version="tiny-1", form="1", stride=8, outputs=("scores", "logits"), seed=0):
    """Write a network to ``path``: grey levels squared as keypoint probability, one random convolution as logits.

    Returns the convolution's weights, shape (bits, 1, stride, stride).
    """
    onnx = pytest.importorskip("onnx", reason="onnx comes with the extra train")
    from onnx import TensorProto, helper, numpy_helper

    weights = np.random.default_rng(seed).normal(size=(bits, 1, stride, stride)).astype(np.float32)
    weights -= weights.mean(axis=(2, 3), keepdims=True)
    nodes = [
        helper.make_node("Mul", ["image", "image"], ["squared"]),
        helper.make_node("Squeeze", ["squared", "axis"], [outputs[0]]),
        helper.make_node("Conv", ["image", "weights"], [outputs[1]], strides=[stride, stride]),
    ]
    graph = helper.make_graph(
        nodes,
        "tiny",
        [helper.make_tensor_value_info("image", TensorProto.FLOAT, [1, 1, "H", "W"])],
        [
            helper.make_tensor_value_info(outputs[0], TensorProto.FLOAT, [1, "H", "W"]),
            helper.make_tensor_value_info(outputs[1], TensorProto.FLOAT, [1, bits, "h", "w"]),
        ],
        [numpy_helper.from_array(weights, "weights"), numpy_helper.from_array(np.array([1]), "axis")],
    )
    network = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    metadata = {"fcslam_version": version, "fcslam_format": form}
    helper.set_model_props(network, {key: value for key, value in metadata.items() if value is not None})
    onnx.save(network, str(path))
    return weights
