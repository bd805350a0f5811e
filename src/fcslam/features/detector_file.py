"""Network files that the cloud distributes to robots: their description, and the check of a downloaded file."""

import hashlib
from pathlib import Path

from fcslam.errors import FeatureError
from fcslam.features.detector import NETWORK_FORMAT, FeatureDetector, OnnxConfig, OnnxDetector
from fcslam.features.network_check import check_network
from fcslam.records import Channel, DetectorFile
from fcslam.untrusted import read_bytes


def describe_detector_file(path: Path) -> DetectorFile:
    """Describe a network file (version, format, size, SHA-256) for the announcement to a fleet.

    Raises:
        FeatureError: the file is not a usable network.
    """
    check_network(path)
    version = OnnxDetector(OnnxConfig(weights=path)).version
    content = _read(path)
    digest = hashlib.sha256(content).digest()
    return DetectorFile(Channel.CAMERA, version, int(NETWORK_FORMAT), len(content), digest)


def open_detector_file(file: DetectorFile, path: Path) -> FeatureDetector:
    """Load a downloaded network after a check against its announcement ``file``.

    Raises:
        FeatureError: the file differs from the announcement, or this fcslam cannot run the network.
    """
    if file.format != int(NETWORK_FORMAT):
        raise FeatureError(f"{file.version}: its format is {file.format}, not {NETWORK_FORMAT}; update fcslam")
    content = _read(path)
    if len(content) != file.size or hashlib.sha256(content).digest() != file.sha256:
        raise FeatureError(f"{path}: is not the file that was announced as {file.version}; fetch it again")
    check_network(path)
    detector = OnnxDetector(OnnxConfig(weights=path))
    if detector.version != file.version:
        raise FeatureError(f"{path}: holds detector {detector.version}, but was announced as {file.version}")
    return detector


def _read(path: Path) -> bytes:
    try:
        return read_bytes(path)
    except OSError as error:
        raise FeatureError(f"{path}: cannot be read ({error}); fetch it again") from error
