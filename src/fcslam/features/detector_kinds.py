"""Names of detectors for the command line and the settings. Imports no library, so that help is fast."""

from enum import StrEnum


class DetectorKind(StrEnum):
    """Detectors of camera places on a robot."""

    ORB = "orb"
    ONNX = "onnx"


class EvaluatedDetectorKind(StrEnum):
    """Detectors of the homography evaluation."""

    ONNX = "onnx"
    LOGITS = "logits"
    """The same network, its descriptors compared by logits instead of bits."""
    ORB = "orb"
    SIFT = "sift"
    FAST = "fast"
    HARRIS = "harris"
    SHI = "shi"
