"""Makes the detector of camera images that the settings name."""

from fcslam.features.classical import Orb, OrbConfig
from fcslam.features.detector import FeatureDetector, OnnxConfig, OnnxDetector
from fcslam.features.detector_kinds import DetectorKind


def make_detector(kind: DetectorKind, orb: OrbConfig, onnx: OnnxConfig) -> FeatureDetector:
    """Make a detector of the given kind; only its own settings are used.

    Raises:
        FeatureError: the weights of the network cannot be used.
    """
    return OnnxDetector(onnx) if kind is DetectorKind.ONNX else Orb(orb)
