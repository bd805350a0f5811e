"""The detectors of a homography evaluation: detectors that run here, and features that other programs extracted."""

import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from fcslam.errors import EvaluationError
from fcslam.features.classical import Fast, Harris, Orb, OrbConfig, ShiTomasi, Sift
from fcslam.features.detector import (
    BUNDLED_NETWORK,
    MATCHING_SCALES,
    GreyImage,
    ImageFeatures,
    KeypointDetector,
    Keypoints,
    OnnxConfig,
    OnnxDetector,
)
from fcslam.features.detector_kinds import EvaluatedDetectorKind
from fcslam.features.files import read_features, read_grey
from fcslam.metrics.homography import Framing, Size, inside

_CANDIDATES = 1500
"""Most features of ORB and SIFT, as in SuperPoint's evaluation."""
_NETWORK_CANDIDATES = 2000
"""Most features of a network."""
_NETWORKS = (EvaluatedDetectorKind.ONNX, EvaluatedDetectorKind.LOGITS)


@dataclass(frozen=True, slots=True)
class FramedImage:
    """An image of a scene, scaled and cropped to a size."""

    path: Path
    file_size: Size
    """Size of the original image."""
    framing: Framing
    grey: GreyImage


@dataclass(frozen=True, slots=True)
class EvaluatedDetector:
    """A named source of keypoints, the strongest first, in pixels of the framed image."""

    name: str
    find: Callable[[FramedImage], Keypoints]
    is_timed: bool
    """Whether the run time of ``find`` is that of detection."""


class Stopwatch:
    """CPU time of detectors per image, which other load on the machine hardly affects."""

    def __init__(self) -> None:
        self._seconds: defaultdict[tuple[str, Size], list[float]] = defaultdict(list)

    def find(self, detector: EvaluatedDetector, picture: FramedImage) -> Keypoints:
        """Run a detector and record its CPU time."""
        began = time.process_time()
        found = detector.find(picture)
        if detector.is_timed:
            height, width = picture.grey.shape
            self._seconds[detector.name, (width, height)].append(time.process_time() - began)
        return found

    def milliseconds(self) -> Mapping[tuple[str, Size], float]:
        """Median CPU time for each detector and image size."""
        return {key: 1e3 * float(np.median(seconds)) for key, seconds in self._seconds.items()}


def frame(path: Path, size: Size) -> FramedImage:
    """Read an image, scale it bilinearly and crop it to ``size``.

    Raises:
        FeatureError: the image cannot be read.
    """
    image = read_grey(path)
    height, width = image.shape
    framing = Framing.of((width, height), size)
    scaled = cv2.resize(image, (max(size[0], int(width * framing.scale)), max(size[1], int(height * framing.scale))))
    left, top = framing.crop_px
    return FramedImage(path, (width, height), framing, np.ascontiguousarray(scaled[top:, left:][: size[1], : size[0]]))


def choose_detectors(
    names: Sequence[EvaluatedDetectorKind], weights: Sequence[Path], folders: Sequence[Path]
) -> tuple[EvaluatedDetector, ...]:
    """Choose extracted features first, then the named detectors; by default all available detectors.

    ``weights``: ONNX files, each a detector of its own; empty: the bundled network. ``folders`` hold extracted
    features.

    Raises:
        FeatureError: a network's weights cannot be used.
        EvaluationError: two detectors have one name, or there is no folder of that name.
    """
    if not names and not folders:
        has_network = bool(weights) or BUNDLED_NETWORK.is_file()
        names = [name for name in EvaluatedDetectorKind if has_network or name not in _NETWORKS]
    detectors, networks = [_extracted(folder) for folder in folders], list[Path | None](weights) or [None]
    for name in names:
        detectors += [_network(name, path) for path in networks] if name in _NETWORKS else [_classical(name)]
    doubled = {each.name for each in detectors if [other.name for other in detectors].count(each.name) > 1}
    if doubled:
        raise EvaluationError(
            f"{min(doubled)}: named twice; give each detector and network once, and folders other names"
        )
    return tuple(detectors)


@contextmanager
def one_thread() -> Iterator[None]:
    """Run OpenCV on a single thread, as on a robot, so that CPU times are comparable."""
    before = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        yield
    finally:
        cv2.setNumThreads(before)


def _network(name: EvaluatedDetectorKind, weights: Path | None) -> EvaluatedDetector:
    network = OnnxDetector(OnnxConfig(weights=weights, most_features=_NETWORK_CANDIDATES, scales=MATCHING_SCALES))
    if name is EvaluatedDetectorKind.LOGITS:
        return _run_here(f"{network.version}-logits", network.detect_floats)
    return _run_here(network.version, network.detect)


def _classical(name: EvaluatedDetectorKind) -> EvaluatedDetector:
    detectors: dict[EvaluatedDetectorKind, KeypointDetector] = {
        EvaluatedDetectorKind.FAST: Fast(),
        EvaluatedDetectorKind.HARRIS: Harris(),
        EvaluatedDetectorKind.SHI: ShiTomasi(),
        EvaluatedDetectorKind.SIFT: Sift(_CANDIDATES),
        EvaluatedDetectorKind.ORB: Orb(OrbConfig(most_features=_CANDIDATES, fast_threshold=20)),
    }
    return _run_here(name.value, detectors[name].detect)


def _run_here(name: str, find: Callable[[GreyImage], Keypoints]) -> EvaluatedDetector:
    find(np.zeros((32, 32), np.uint8))  # warm-up: excludes the cost of the first call
    return EvaluatedDetector(name, lambda picture: find(picture.grey), is_timed=True)


def _extracted(folder: Path) -> EvaluatedDetector:
    if not folder.is_dir():
        raise EvaluationError(f"{folder}: no such folder; name one with features, SCENE/1.npz ...")
    return EvaluatedDetector(folder.resolve().name, lambda picture: _read_framed(folder, picture), is_timed=False)


def _read_framed(folder: Path, picture: FramedImage) -> ImageFeatures:
    """Features of the original image, transformed to pixels of the framed image."""
    path = folder / picture.path.parent.name / f"{picture.path.stem}.npz"
    features, size = read_features(path)
    if size != picture.file_size:
        raise EvaluationError(
            f"{path}: of an image of {size[0]} x {size[1]} pixels, but {picture.path} has "
            f"{picture.file_size[0]} x {picture.file_size[1]}; extract from these scenes"
        )
    scale, crop = picture.framing.scale, np.array(picture.framing.crop_px)
    points = scale * features.keypoints_px.astype(np.float64) - crop
    height, width = picture.grey.shape
    rows = np.flatnonzero(inside(points, (width, height)))
    kept = features.take(rows)
    return ImageFeatures(points[rows].astype(np.float32), kept.scores, kept.descriptors)
