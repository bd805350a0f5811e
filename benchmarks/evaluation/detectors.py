"""The detectors of a homography evaluation, and its scenes in the layout of HPatches (Balntas et al. 2017).

A scene shows a plane, or a turning camera took it. It is a folder with images ``1.*``, ``2.*`` ... and text files
``H_1_2``, ``H_1_3`` ..., 3 x 3 numbers each, which map pixels of image 1 to the other image. Its name begins with
``i_`` if the illumination changes, with ``v_`` if the viewpoint changes. If a homography is rough, ``points_1_2.txt``
has points of the plane, a line of x1 y1 x2 y2 each, and only these judge an estimate.
"""

import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from enum import StrEnum
from functools import partial
from pathlib import Path

import cv2
import numpy as np

from fcslam.errors import InputError
from fcslam.features.classical import Orb
from fcslam.features.detector import (
    BUNDLED_NETWORK,
    MATCHING_SCALES,
    GreyImage,
    Keypoints,
    OnnxConfig,
    OnnxDetector,
)
from fcslam.features.files import read_grey
from fcslam.learning.homography import Size
from fcslam.records import FloatArray, frozen
from fcslam.untrusted import read_text

from .baselines import Fast, Harris, KeypointDetector, ShiTomasi, Sift, logit_features


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


_CANDIDATES = 1500
"""Most features of ORB and SIFT, as in SuperPoint's evaluation."""
_NETWORK_CANDIDATES = 2000
"""Most features of a network."""
_NETWORKS = (EvaluatedDetectorKind.ONNX, EvaluatedDetectorKind.LOGITS)


@dataclass(frozen=True, slots=True)
class Framing:
    """Scaling with constant aspect ratio and cropping around the centre, to a given size."""

    scale: float
    crop_px: tuple[int, int]
    """Columns cut off at the left and rows cut off at the top, after scaling."""

    @classmethod
    def of(cls, image: Size, target: Size) -> "Framing":
        """Framing with the smallest scale at which the image covers the target."""
        scale = max(target[0] / image[0], target[1] / image[1])
        cut = [int(0.5 * (side * scale - wanted)) for side, wanted in zip(image, target, strict=True)]
        return cls(scale, (cut[0], cut[1]))

    @property
    def matrix(self) -> FloatArray:
        """Homography from pixels of the image to pixels of the framed image, shape (3, 3)."""
        return np.array([[self.scale, 0.0, -self.crop_px[0]], [0.0, self.scale, -self.crop_px[1]], [0.0, 0.0, 1.0]])


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
    names: Sequence[EvaluatedDetectorKind], weights: Sequence[Path], scales: tuple[float, ...] = MATCHING_SCALES
) -> tuple[EvaluatedDetector, ...]:
    """The named detectors; by default all available ones.

    ``weights``: ONNX files, each a detector of its own; empty: the bundled network. ``scales``: of its image pyramid.

    Raises:
        FeatureError: a network's weights cannot be used.
        InputError: two detectors have one name.
    """
    if not names:
        has_network = bool(weights) or BUNDLED_NETWORK.is_file()
        names = [name for name in EvaluatedDetectorKind if has_network or name not in _NETWORKS]
    detectors, networks = list[EvaluatedDetector](), list[Path | None](weights) or [None]
    for name in names:
        detectors += [_network(name, path, scales) for path in networks] if name in _NETWORKS else [_classical(name)]
    doubled = {each.name for each in detectors if [other.name for other in detectors].count(each.name) > 1}
    if doubled:
        raise InputError(f"{min(doubled)}: named twice; give each detector and network once")
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


def _network(name: EvaluatedDetectorKind, weights: Path | None, scales: tuple[float, ...]) -> EvaluatedDetector:
    network = OnnxDetector(OnnxConfig(weights=weights, most_features=_NETWORK_CANDIDATES, scales=scales))
    if name is EvaluatedDetectorKind.LOGITS:
        return _run_here(f"{network.version}-logits", partial(logit_features, network))
    return _run_here(network.version, network.detect)


def _classical(name: EvaluatedDetectorKind) -> EvaluatedDetector:
    detectors: dict[EvaluatedDetectorKind, KeypointDetector] = {
        EvaluatedDetectorKind.FAST: Fast(),
        EvaluatedDetectorKind.HARRIS: Harris(),
        EvaluatedDetectorKind.SHI: ShiTomasi(),
        EvaluatedDetectorKind.SIFT: Sift(_CANDIDATES),
        EvaluatedDetectorKind.ORB: Orb(most_features=_CANDIDATES, fast_threshold=20),
    }
    return _run_here(name.value, detectors[name].detect)


def _run_here(name: str, find: Callable[[GreyImage], Keypoints]) -> EvaluatedDetector:
    find(np.zeros((32, 32), np.uint8))  # warm-up: excludes the cost of the first call
    return EvaluatedDetector(name, lambda picture: find(picture.grey), is_timed=True)


class SceneKind(StrEnum):
    """Change between the images of a scene, from its name."""

    ILLUMINATION = "i"
    VIEWPOINT = "v"
    OTHER = "-"

    @classmethod
    def of(cls, name: str) -> "SceneKind":
        """The kind of a scene with this name."""
        return cls(name[0]) if name.startswith(("i_", "v_")) else cls.OTHER


@dataclass(frozen=True, slots=True)
class Scene:
    """Images of one scene with known homographies."""

    name: str
    """Of its folder, after that of its set if two have one name."""
    reference: Path
    """Image 1."""
    others: tuple[tuple[Path, FloatArray], ...]
    """The other images, each with H (3, 3) from image 1 to it."""
    marks: Mapping[Path, tuple[FloatArray, FloatArray]]
    """Of other images of which only some points are known: these in image 1 and there, pixels, shape (N, 2) each."""

    @property
    def kind(self) -> SceneKind:
        """Change between its images."""
        return SceneKind.of(self.name)


def find_scenes(folders: Sequence[Path]) -> list[Scene]:
    """Find scenes, sorted by name. Each folder is a scene, or contains scenes.

    Raises:
        InputError: a folder is or holds none, two scenes have one name, or a scene's files do not fit together.
    """
    scenes: dict[str, Scene] = {}
    for folder in folders:
        found = [place for place in (folder, *sorted(folder.glob("*/"))) if any(place.glob("H_1_*"))]
        if not found:
            raise InputError(f"{folder}: no scene in it; a scene is a folder with images 1, 2 ... and H_1_2 ...")
        for place in found:
            name = place.name if place.name not in scenes else f"{place.parent.name}-{place.name}"
            if name in scenes:
                raise InputError(f"{place}: there is another scene {name}; rename one")
            scenes[name] = _read_scene(name, place)
    return [scenes[name] for name in sorted(scenes)]


def _read_scene(name: str, folder: Path) -> Scene:
    images = {int(path.stem): path for path in sorted(folder.iterdir()) if path.suffix and path.stem.isdecimal()}
    files = sorted(folder.glob("H_1_*"))
    numbers = [path.name.removeprefix("H_1_") for path in files]
    wrong = [path.name for path, number in zip(files, numbers, strict=True) if not number.isdecimal()]
    missing = [number for number in ("1", *numbers) if number.isdecimal() and int(number) not in images]
    if wrong or missing:
        raise InputError(f"{folder}: {f'what is {wrong[0]}?' if wrong else f'image {missing[0]} is missing'}")
    pairs = sorted((int(number), path) for number, path in zip(numbers, files, strict=True))
    others = tuple((images[number], _read_homography(path)) for number, path in pairs)
    marked = ((images[number], folder / f"points_1_{number}.txt") for number, _ in pairs)
    return Scene(name, images[1], others, {image: _read_marks(path) for image, path in marked if path.is_file()})


def _read_marks(path: Path) -> tuple[FloatArray, FloatArray]:
    try:
        points = np.loadtxt(path, ndmin=2)
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: cannot read the points ({error}); give lines of x1 y1 x2 y2") from error
    if points.shape[1] != 4 or not np.isfinite(points).all():
        raise InputError(f"{path}: no points; give lines of x1 y1 x2 y2")
    return points[:, :2], points[:, 2:]


def _read_homography(path: Path) -> FloatArray:
    try:
        H = np.array([float(word) for word in read_text(path).split()])
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: cannot read the homography ({error}); give 3 x 3 numbers") from error
    if H.shape != (9,) or not np.isfinite(H).all() or H[8] == 0.0 or abs(np.linalg.det(H.reshape(3, 3))) < 1e-12:
        raise InputError(f"{path}: no homography; give 3 x 3 finite numbers that can be inverted")
    return frozen(H.reshape(3, 3) / H[8])
