"""Names of detectors, for the command line and the configuration."""

from enum import StrEnum


class DetectorKind(StrEnum):
    """Detectors that describe places."""

    ORB = "orb"
    ONNX = "onnx"


class EvaluatedDetectorKind(StrEnum):
    """Detectors that can be compared."""

    ONNX = "onnx"
    LOGITS = "logits"
    """The same network, compared before its logits become bits."""
    ORB = "orb"
    SIFT = "sift"
    FAST = "fast"
    HARRIS = "harris"
    SHI = "shi"
