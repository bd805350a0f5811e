"""The detector that describes camera images."""

from fcslam.features.classical import Orb, OrbConfig
from fcslam.features.detector import FeatureDetector, OnnxConfig, OnnxDetector
from fcslam.features.detector_kinds import DetectorKind


def make_detector(kind: DetectorKind, orb: OrbConfig, onnx: OnnxConfig) -> FeatureDetector:
    """The detector of that kind.

    Raises:
        FeatureError: it is a network whose weights cannot be used.
    """
    return OnnxDetector(onnx) if kind is DetectorKind.ONNX else Orb(orb)
