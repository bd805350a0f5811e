"""The detector that describes camera images."""

from fcslam.features.classical import Orb, OrbConfig
from fcslam.features.detector import Detector, OnnxConfig, OnnxDetector
from fcslam.features.kinds import DetectorKind


def make_detector(kind: DetectorKind, orb: OrbConfig, onnx: OnnxConfig) -> Detector:
    """The detector of that kind.

    Raises:
        FeatureError: it is a network whose weights cannot be used.
    """
    return OnnxDetector(onnx) if kind is DetectorKind.ONNX else Orb(orb)
