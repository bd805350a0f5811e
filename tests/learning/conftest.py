"""Without fcslam[train], only these of the tests of learning run."""

from importlib.util import find_spec
from pathlib import Path

HERE = Path(__file__).parent
PLAIN = {f"test_{name}.py" for name in ("homography", "labels", "pairs", "revisits", "stages", "standstill")}
HAS_TRAIN = all(map(find_spec, ("torch", "onnx", "onnxruntime")))
collect_ignore = [] if HAS_TRAIN else [str(path) for path in HERE.rglob("test_*.py") if path.name not in PLAIN]
