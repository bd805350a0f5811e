"""Running a network leaves no file and sends nothing."""

import os
import subprocess
import sys

import pytest

from tests.features.networks import tiny_network

pytest.importorskip("onnxruntime")

USE = """
import sys
import numpy as np
from pathlib import Path
from fcslam.features.detector import OnnxConfig, OnnxDetector
OnnxDetector(OnnxConfig(weights=Path(sys.argv[1]))).detect(np.zeros((64, 64), np.uint8))
"""


@pytest.mark.slow
def test_a_detector_leaves_no_file_at_home(tmp_path):
    tiny_network(network := tmp_path / "tiny.onnx")
    (home := tmp_path / "home").mkdir()
    # where tests run by themselves it reports nothing anyway
    hidden = {"CI", "ORT_DISABLE_TELEMETRY", "ORT_RUNNING_UNIT_TESTS"}
    own = {name: value for name, value in os.environ.items() if name not in hidden and not name.startswith("XDG_")}
    environment = {**own, "HOME": str(home), "PYTHONPATH": os.pathsep.join(sys.path)}
    subprocess.run([sys.executable, "-c", USE, str(network)], env=environment, check=True, timeout=120)
    assert [path for path in home.rglob("*") if path.is_file()] == []
