"""Reads image files, extracts the features of images, and writes them, one ``.npz`` for each image.

Arrays: ``keypoints`` (N, 2) float32, x y in pixels of the image, (0, 0) the centre of its first pixel; ``scores`` (N,)
float32; ``descriptors`` (N, 32) uint8, the bits packed; ``image_size`` (2,), width and height.
"""

import os
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from fcslam.errors import FeatureError, writing
from fcslam.features.detector import FeatureDetector, GreyImage, ImageFeatures, decode_grey, in_original, shrink
from fcslam.records import frozen
from fcslam.storage.files import replacing
from fcslam.untrusted import Arrays, read_bytes


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


def find_files(images: Path) -> list[Path]:
    """Return the file itself, or all files in the folder and its subfolders, sorted."""
    if os.path.isfile(images):
        return [images]
    files = sorted(path for path in images.rglob("*") if path.is_file()) if os.path.isdir(images) else []
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
