"""Reads image files, extracts the features of images, and writes and reads them, one ``.npz`` for each image.

Arrays: ``keypoints`` (N, 2) float32, x y in pixels of the image, (0, 0) the centre of its first pixel; ``scores`` (N,)
float32; ``descriptors`` (N, 32) uint8, the bits packed; ``image_size`` (2,), width and height.
"""

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from fcslam.errors import FeatureError, writing
from fcslam.features.detector import FeatureDetector, GreyImage, ImageFeatures, decode_grey, in_original, shrink
from fcslam.records import CODE_BYTES, frozen
from fcslam.storage.files import replacing
from fcslam.untrusted import Arrays, read_arrays, read_bytes

_ARRAYS = ("keypoints", "scores", "descriptors", "image_size")


def read_grey(path: Path) -> GreyImage:
    """Read the grey levels (H, W) of an image file.

    Raises:
        FeatureError: the file cannot be read, is not an image, or is too large.
    """
    try:
        encoded = read_bytes(path, most=1 << 28)
    except OSError as error:
        raise FeatureError(f"{path}: cannot be read ({error})") from error
    image = decode_grey(encoded)
    if image is None or not image.size:
        raise FeatureError(f"{path}: cannot be read as an image; give JPEG, PNG, PPM or TIFF")
    return image


def write_features(path: Path, features: ImageFeatures, image_size: tuple[int, int]) -> None:
    """Write the features of an image of ``image_size`` (width, height), pixels; makes the folder of the file."""
    arrays: Arrays = {
        "keypoints": features.keypoints_px,
        "scores": features.scores,
        "descriptors": features.descriptors,
        "image_size": np.array(image_size, np.int32),
    }
    with writing(path, "make room or choose another folder"):
        path.parent.mkdir(parents=True, exist_ok=True)
        with replacing(path) as unfinished, unfinished.open("wb") as file:
            np.savez(file, allow_pickle=False, **arrays)


def read_features(path: Path) -> tuple[ImageFeatures, tuple[int, int]]:
    """Read features, the strongest first, and the width and height of their image in pixels.

    Raises:
        FeatureError: the file cannot be read, or is not of this format.
    """
    try:
        archive = read_arrays(path)
        keypoints, scores, descriptors, size = (archive[name] for name in _ARRAYS)
    except (OSError, ValueError, KeyError) as error:
        raise FeatureError(f"{path}: cannot read the features ({error}); write {', '.join(_ARRAYS)}") from error
    count = len(scores) if scores.ndim == 1 else -1
    shapes = (keypoints.shape, descriptors.shape, size.shape)
    if shapes != ((count, 2), (count, CODE_BYTES), (2,)) or descriptors.dtype != np.uint8:
        raise FeatureError(
            f"{path}: keypoints {keypoints.shape}, scores {scores.shape}, descriptors {descriptors.shape} "
            f"{descriptors.dtype}, image_size {size.shape}; expected (N, 2), (N,), (N, {CODE_BYTES}) uint8, (2,)"
        )
    if any(array.dtype.kind not in "fiu" or not np.isfinite(array).all() for array in (keypoints, scores, size)):
        raise FeatureError(f"{path}: keypoints, scores and image_size must be finite numbers")
    order = np.argsort(-scores.astype(np.float64), kind="stable")
    features = ImageFeatures(
        frozen(keypoints[order], np.float32), frozen(scores[order], np.float32), frozen(descriptors[order], np.uint8)
    )
    return features, (int(size[0]), int(size[1]))


def find_files(images: Path) -> list[Path]:
    """Return the file itself, or all files in the folder and its subfolders, sorted."""
    files = [images] if images.is_file() else sorted(path for path in images.rglob("*") if path.is_file())
    if not files:
        raise FeatureError(f"{images}: no file there; name an image or a folder of images")
    return files


def extract_all(
    files: list[Path], root: Path, output: Path, detector: FeatureDetector, longest_side_px: int
) -> Iterator[tuple[Path, int | str]]:
    """Write the features of each image below ``output``, at the image's path relative to ``root``.

    Gives each file with the number of its keypoints, or with the reason why it is skipped.
    """
    written: dict[Path, Path] = {}
    for path in files:
        target = output / path.relative_to(root).with_suffix(".npz")
        try:
            if target in written:
                raise FeatureError(f"{path}: has the features' name in common with {written[target]}; rename one")
            image = read_grey(path)
        except FeatureError as error:
            yield path, str(error)
            continue
        features = extract(image, detector, longest_side_px)
        write_features(target, features, (image.shape[1], image.shape[0]))
        written[target] = path
        yield path, len(features.scores)


def extract(image: GreyImage, detector: FeatureDetector, longest_side_px: int) -> ImageFeatures:
    """Detect the features of an image (H, W), downscaled if its longer side exceeds ``longest_side_px``.

    Keypoints are in pixels of the original image.
    """
    shrunk = shrink(image, longest_side_px / max(image.shape))
    found = detector.detect(shrunk)
    positions = in_original(found.keypoints_px, shrunk, image)
    return ImageFeatures(frozen(positions, np.float32), found.scores, found.descriptors)
