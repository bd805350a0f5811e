"""Networks from somebody else are refused before they take memory or time."""

import numpy as np
import pytest

from fcslam.errors import FeatureError
from fcslam.features.detector import BUNDLED_NETWORK
from fcslam.features.network_check import check_network
from tests.features.networks import tiny_network

pytestmark = pytest.mark.slow


def test_own_networks_pass(tmp_path):
    check_network(BUNDLED_NETWORK)
    tiny_network(tmp_path / "a.onnx")
    check_network(tmp_path / "a.onnx")


@pytest.mark.parametrize("kind", ["loop", "huge constant", "huge array", "other file", "other domain", "many nodes"])
def test_a_network_unlike_the_own_ones_is_refused(tmp_path, kind):
    path = tmp_path / "a.onnx"
    tiny_network(path)
    onnx = pytest.importorskip("onnx")
    from onnx import helper, numpy_helper

    model = onnx.load(str(path))
    graph = model.graph
    reason = kind
    match kind:
        case "loop":
            body = helper.make_graph([], "body", [], [])
            graph.node.insert(0, helper.make_node("Loop", ["", ""], ["x"], body=body))
            reason = "operator 'Loop'"
        case "huge constant":
            graph.initializer.append(numpy_helper.from_array(np.array([3_000_000_000]), "shape"))
            graph.node.insert(0, helper.make_node("ConstantOfShape", ["shape"], ["zeros"]))
            graph.node[1].input[1] = "zeros"
            model.graph.node[1].op_type = "Add"
            reason = "limits of|does not run|not an ONNX"
        case "huge array":
            graph.initializer[0].dims[:] = [1 << 20, 1 << 20]
            reason = "the limit"
        case "other file":
            graph.initializer[0].external_data.add(key="location", value="/etc/passwd")
        case "other domain":
            graph.node[0].domain = "com.example"
            reason = "operator"
        case "many nodes":
            graph.node.extend(helper.make_node("Relu", ["image"], [f"r{n}"]) for n in range(2100))
            reason = "the limit"
    path.write_bytes(model.SerializeToString())
    with pytest.raises(FeatureError, match=reason) as caught:
        check_network(path)
    assert "\n" not in str(caught.value)
