"""Interface of keypoint detectors in camera images, and the detector that runs a network.

A network is an ONNX file, run by ONNX Runtime on the CPU. Its format, ``fcslam_format`` 1:

- input ``image``, float32 (1, 1, H, W): grey levels in [0, 1]; H and W are any multiples of 8;
- output ``scores``, float32 (1, H, W): the probability of a keypoint, for every pixel;
- output ``logits``, float32 (1, 256, H / 8, W / 8): logits of the descriptor's bits, for the cells of ``dense``;
- metadata ``fcslam_format`` and ``fcslam_version``: the version that all its descriptors carry.
"""

import os
from dataclasses import dataclass, fields, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Final, Protocol, Self

import cv2
import numpy as np
from numpy.typing import NDArray

from fcslam.errors import FeatureError
from fcslam.features.codes import CODE_BITS
from fcslam.features.dense import CELL_PX, Logits, Probabilities, find_peaks, sample_logits
from fcslam.records import CODE_BYTES, NAME, Codes, frozen
from fcslam.untrusted import check_image, read_bytes

NETWORK_FORMAT: Final = "1"
"""Format of networks that this version of fcslam reads."""
BUNDLED_NETWORK: Final = Path(__file__).parent / "networks" / "detector.onnx"
"""The bundled network; a package may be built without it."""
BUNDLED_VERSION: Final = "light-723cb7f52404"
"""Its version. A robot without a camera names it and never loads ONNX Runtime."""

MATCHING_SCALES: Final = (1.0, 0.71, 0.5)
"""Scales at which two views match best. Robots recognise places as well with one scale, in a third of the time."""

GreyImage = NDArray[np.uint8]
"""Shape (height, width)."""


class MissingExtraError(FeatureError):
    """A package is missing that an extra installs."""


def load_onnx_runtime() -> Any:
    """Import ``onnxruntime`` without telemetry; call this before any other import of it.

    On Linux, the official builds since 1.29 send telemetry and keep an identifier and a database in
    ``~/.cache/Microsoft/DeveloperTools`` (https://github.com/microsoft/onnxruntime/pull/27379).
    ``disable_telemetry_events`` stops the events, but only the environment variable prevents the files.

    Raises:
        MissingExtraError: it is not installed.
    """
    os.environ["ORT_DISABLE_TELEMETRY"] = "1"
    try:
        import onnxruntime
    except ModuleNotFoundError as error:
        raise MissingExtraError(
            "describing camera images needs ONNX Runtime; install it: pip install 'fcslam[camera]', or map without "
            "cameras: robot.channels: [lidar]"
        ) from error
    onnxruntime.disable_telemetry_events()  # in case another module imported it before
    return onnxruntime


@dataclass(frozen=True, slots=True)
class Keypoints:
    """Keypoints of one image, the strongest first."""

    keypoints_px: NDArray[np.float32]
    """Shape (K, 2): x to the right, y down; (0, 0) is the centre of the first pixel."""
    scores: NDArray[np.float32]
    """Shape (K,), comparable only within one detector."""

    def take(self, rows: NDArray[np.int64] | slice) -> Self:
        """Select keypoints with all their attributes, in the order of ``rows`` (M,)."""
        arrays = {field.name: getattr(self, field.name) for field in fields(self)}
        return replace(self, **{name: frozen(array[rows], array.dtype.type) for name, array in arrays.items()})


@dataclass(frozen=True, slots=True)
class ImageFeatures(Keypoints):
    """Keypoints with binary descriptors of 256 bits."""

    descriptors: Codes
    """Shape (K, 32)."""


NO_FEATURES = ImageFeatures(
    frozen(np.empty((0, 2)), np.float32), frozen(np.empty(0), np.float32), frozen(np.empty((0, CODE_BYTES)), np.uint8)
)


class FeatureDetector(Protocol):
    """Finds keypoints and describes each by 256 bits."""

    @property
    def version(self) -> str:
        """Changes whenever the same image gives other descriptors; descriptors of two versions are never compared."""

    def detect(self, image: GreyImage) -> ImageFeatures:
        """Features of an image (H, W), the strongest first; K = 0 without any."""


def network_file(weights: Path | None) -> Path:
    """The ONNX file that ``weights`` names; None is the bundled network, and a bare name like `vgg` another one."""
    if weights is None:
        return BUNDLED_NETWORK
    bundled = BUNDLED_NETWORK.with_name(f"{weights.name}.onnx")
    return bundled if weights == Path(weights.name) and bundled.is_file() else weights


@dataclass(frozen=True, slots=True)
class OnnxConfig:
    """The network detector. Places from different weights cannot be compared."""

    weights: Path | None = None
    """ONNX file with the network weights; None: the bundled network; vgg: the paper's, also bundled."""
    most_features: int = 300
    """Most features of an image, the strongest first."""
    nms_px: float = 4.0
    """Side of the boxes of non-maximum suppression around keypoints."""
    scales: tuple[float, ...] = (1.0,)
    """Scales of the image pyramid; the strongest keypoints of all scales together are kept."""
    least_score: float = 0.005
    """Smallest probability of a keypoint."""
    threads: int = 1
    """CPU threads of the network."""


class OnnxDetector:
    """Keypoints and codes by a network."""

    def __init__(self, config: OnnxConfig) -> None:
        """Load and try the network; the bundled one is loaded for the first image."""
        self._config = config
        if config.weights is None and not BUNDLED_NETWORK.is_file():
            raise FeatureError("no network weights come with this version of fcslam; name an .onnx file, or choose orb")
        self._path = network_file(config.weights)
        self._version = BUNDLED_VERSION if self._path == BUNDLED_NETWORK else self._loaded[1]

    @cached_property
    def _loaded(self) -> tuple[Any, str]:
        """Session and version of the network, whose output is checked."""
        path, (session, metadata) = self._path, _load(self._path, self._config.threads)
        if metadata.get("fcslam_format") != NETWORK_FORMAT:
            found = metadata.get("fcslam_format", "none")
            raise FeatureError(
                f"{path}: its format is {found}, not {NETWORK_FORMAT}; give weights made for this fcslam"
            )
        version = metadata.get("fcslam_version", "")
        if not NAME.fullmatch(version):
            raise FeatureError(f"{path}: '{version}' is not a detector version; export the network with one")
        _check(session, path)
        return session, version

    @property
    def version(self) -> str:
        """As in ``FeatureDetector``."""
        return self._version

    def detect(self, image: GreyImage) -> ImageFeatures:
        """Features of an image (H, W) of any size, ranked by keypoint probability."""
        found, sampled = self.find(image)
        return ImageFeatures(found.keypoints_px, found.scores, frozen(np.packbits(sampled >= 0.0, axis=1), np.uint8))

    def infer(self, image: GreyImage) -> tuple[Probabilities, Logits]:
        """Keypoint probabilities (H, W) of an image, and logits (256, rows, columns) of the cells that cover it."""
        height, width = image.shape
        if not image.size:
            return np.empty(image.shape, np.float32), np.zeros((CODE_BITS, 1, 1), np.float32)
        scores, logits = _run(self._loaded[0], padded(image))
        return scores[:height, :width], logits

    def find(self, image: GreyImage) -> tuple[Keypoints, NDArray[np.float32]]:
        """The strongest keypoints of all scales, and their logits (K, 256)."""
        levels = [self._find_at(image, scale) for scale in self._config.scales]
        positions, strengths, logits = (np.concatenate(parts) for parts in zip(*levels, strict=True))
        kept = np.argsort(-strengths, kind="stable")[: self._config.most_features]
        return Keypoints(frozen(positions[kept], np.float32), frozen(strengths[kept], np.float32)), logits[kept]

    def _find_at(self, image: GreyImage, scale: float) -> tuple[NDArray[np.float32], ...]:
        """Positions (K, 2) in pixels of the image, scores (K,) and logits (K, 256) at one scale.

        Scores are multiplied by the scale, because the position of a coarse keypoint is as much less precise.
        """
        config = self._config
        level = shrink(image, scale)
        scores, cells = self.infer(level)
        positions, strengths = find_peaks(scores, config.least_score, config.nms_px, config.most_features)
        return in_original(positions, level, image), np.float32(scale) * strengths, sample_logits(cells, positions)


def decode_grey(encoded: bytes) -> GreyImage | None:
    """Decode an image file to 8-bit grey levels (H, W), without EXIF orientation; None if it is broken or too large.

    Colours are weighted as in ITU-R BT.601, transparency is ignored, and 16-bit values keep their upper 8 bits.
    """
    try:
        check_image(encoded)
        decoded = cv2.imdecode(np.frombuffer(encoded, np.uint8), cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION)
    except (OSError, ValueError, cv2.error):
        return None
    return None if decoded is None else np.asarray(decoded, np.uint8)


def _load(path: Path, threads: int) -> tuple[Any, dict[str, str]]:
    """An ONNX Runtime session and the metadata of the file."""
    try:
        content = read_bytes(path)
    except OSError as error:
        raise FeatureError(f"{path}: cannot read the network weights ({error}); name an .onnx file") from error

    onnxruntime = load_onnx_runtime()
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads, options.inter_op_num_threads = threads, 1
    options.log_severity_level = 4  # only fatal messages: errors are raised
    try:
        session = onnxruntime.InferenceSession(content, options, providers=["CPUExecutionProvider"])
    except Exception as error:  # ONNX Runtime has no common exception
        raise FeatureError(f"{path}: not an ONNX network ({error}); give weights of an fcslam detector") from error
    return session, dict(session.get_modelmeta().custom_metadata_map)


def _run(session: Any, image: GreyImage) -> tuple[Probabilities, Logits]:
    grey = (image.astype(np.float32) / np.float32(255.0))[None, None]
    scores, logits = session.run(["scores", "logits"], {"image": grey})
    return scores[0], logits[0]


def _check(session: Any, path: Path) -> None:
    """Run the network on a small image and check its output, because its metadata may be wrong."""
    rows, columns = 3, 5
    try:
        scores, logits = _run(session, np.full((rows * CELL_PX, columns * CELL_PX), 128, np.uint8))
    except Exception as error:  # ONNX Runtime has no common exception
        raise FeatureError(f"{path}: the network does not run ({error}); give weights of an fcslam detector") from error
    expected = ((rows * CELL_PX, columns * CELL_PX), (CODE_BITS, rows, columns))
    if (scores.shape, logits.shape) != expected or not (np.isfinite(scores).all() and np.isfinite(logits).all()):
        raise FeatureError(
            f"{path}: for {columns * CELL_PX} x {rows * CELL_PX} pixels it gives {scores.shape} scores and "
            f"{logits.shape} logits, not finite ones of {expected[0]} and {expected[1]}; give other weights"
        )


def shrink(image: GreyImage, scale: float) -> GreyImage:
    """Shrink an image (H, W) by area averaging; a scale of 1 or more, or an empty image, leaves it as it is."""
    height, width = image.shape
    if scale >= 1.0 or not image.size:
        return image
    size = (max(1, round(width * scale)), max(1, round(height * scale)))
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)


def in_original(positions_px: NDArray[np.float32], shrunk: GreyImage, image: GreyImage) -> NDArray[np.float32]:
    """Positions (K, 2) of a shrunk image in pixels of the original one."""
    if shrunk is image:
        return positions_px
    scale = np.array(image.shape[::-1]) / np.array(shrunk.shape[::-1])
    return np.asarray((positions_px + 0.5) * scale - 0.5, np.float32)


def padded(image: GreyImage) -> GreyImage:
    """Pad an image (H, W) by reflection at the lower and right edge to whole cells."""
    height, width = image.shape
    whole = cv2.copyMakeBorder(image, 0, -height % CELL_PX, 0, -width % CELL_PX, cv2.BORDER_REFLECT_101)
    return np.asarray(whole, np.uint8)
