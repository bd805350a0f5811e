"""Names of detectors for the command line and the settings. Imports no library, so that help is fast."""

from enum import StrEnum


class DetectorKind(StrEnum):
    """Detectors of camera places on a robot."""

    ORB = "orb"
    ONNX = "onnx"
