"""Extracts the features of every image in a folder, one file for each image."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from fcslam.errors import FeatureError, OutputError
from fcslam.features.detector import FeatureDetector, GreyImage, ImageFeatures, in_original, shrink
from fcslam.features.files import read_grey, write_features
from fcslam.records import frozen


@dataclass(frozen=True, slots=True)
class Extraction:
    """Result of one file."""

    path: Path
    keypoints: int
    skipped: str = ""
    """Why no features were written; empty if they were."""


def find_files(images: Path) -> list[Path]:
    """Return the file itself, or all files in the folder and its subfolders, sorted.

    Raises:
        FeatureError: there is no file.
    """
    files = [images] if images.is_file() else sorted(path for path in images.rglob("*") if path.is_file())
    if not files:
        raise FeatureError(f"{images}: no file there; name an image or a folder of images")
    return files


def extract_all(
    files: list[Path], root: Path, output: Path, detector: FeatureDetector, longest_side_px: int
) -> Iterator[Extraction]:
    """Write the features of each image below ``output``, at the image's path relative to ``root``.

    Files that cannot be read are skipped and reported.

    Raises:
        OutputError: features cannot be written.
    """
    written: dict[Path, Path] = {}
    for path in files:
        target = output / path.relative_to(root).with_suffix(".npz")
        try:
            if target in written:
                raise FeatureError(f"{path}: has the features' name in common with {written[target]}; rename one")
            image = read_grey(path)
        except FeatureError as error:
            yield Extraction(path, 0, str(error))
            continue
        features = extract(image, detector, longest_side_px)
        try:
            target.parent.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise OutputError(f"{target.parent}: cannot be made ({error}); choose another folder") from error
        write_features(target, features, (image.shape[1], image.shape[0]))
        written[target] = path
        yield Extraction(path, len(features.scores))


def extract(image: GreyImage, detector: FeatureDetector, longest_side_px: int) -> ImageFeatures:
    """Detect the features of an image (H, W), downscaled if its longer side exceeds ``longest_side_px``.

    Keypoints are in pixels of the original image.
    """
    shrunk = shrink(image, longest_side_px / max(image.shape))
    found = detector.detect(shrunk)
    positions = in_original(found.keypoints_px, shrunk, image)
    return ImageFeatures(frozen(positions, np.float32), found.scores, found.descriptors)
