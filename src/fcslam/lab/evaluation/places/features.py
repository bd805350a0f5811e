"""Describes sets of places with the features of a chosen detector."""

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from fcslam.errors import EvaluationError, FeatureError
from fcslam.features.classical import Orb, OrbConfig
from fcslam.features.detector import FeatureDetector, ImageFeatures, OnnxConfig, OnnxDetector
from fcslam.features.detector_kinds import DetectorKind
from fcslam.features.files import extract, find_files, read_features, read_grey
from fcslam.lab.evaluation.places.lidar_places import describe_recording
from fcslam.lab.evaluation.places.scoring import DescribedSet, PlaceFeatures
from fcslam.lab.evaluation.places.sets import PlaceSet, all_images, read_place_set
from fcslam.lab.evaluation.places.verification import epipolar_inliers
from fcslam.records import Codes

FEATURES_PER_IMAGE: Final = 500
LONGEST_SIDE_PX: Final = 400
FAST_THRESHOLD: Final = 20
"""FAST threshold of ORB, OpenCV's default [grey levels of 255]."""

_IMAGES = {".jpg", ".jpeg", ".png", ".ppm", ".tif", ".tiff"}


@dataclass(frozen=True, slots=True)
class FeatureChoice:
    """A detector, or a folder with the features that another program extracted."""

    name: str
    detector: FeatureDetector | None
    extracted: Path | None = None

    def of(self, image: Path, root: Path) -> PlaceFeatures:
        """The 500 strongest features of an image downscaled to 400 pixels; ``root`` is the folder of its set.

        Raises:
            FeatureError: the image or its features cannot be read.
        """
        if self.detector is not None:
            return _places(extract(read_grey(image), self.detector, LONGEST_SIDE_PX))
        folder = self.extracted or Path()
        path = folder / root.resolve().name / image.relative_to(root).with_suffix(".npz")
        return _places(read_features(path)[0].take(slice(FEATURES_PER_IMAGE)))


def choose_features(choice: str) -> FeatureChoice:
    """Choose features by a detector's name, an .onnx file, or a folder of extracted features.

    Raises:
        FeatureError: ``choice`` is no detector, .onnx file or folder, or the network cannot be used.
    """
    path = Path(choice)
    if choice == DetectorKind.ORB:
        return FeatureChoice(choice, Orb(OrbConfig(most_features=FEATURES_PER_IMAGE, fast_threshold=FAST_THRESHOLD)))
    if choice == DetectorKind.ONNX or path.is_file():
        weights = None if choice == DetectorKind.ONNX else path
        network = OnnxDetector(OnnxConfig(weights=weights, most_features=FEATURES_PER_IMAGE))
        return FeatureChoice(network.version, network)
    if path.is_dir():
        return FeatureChoice(path.resolve().name, None, path)
    raise FeatureError(f"{choice}: no such features; give orb, onnx, an .onnx file or a folder of extracted features")


def describe_sets(
    paths: Sequence[Path], labels: Collection[str], features: FeatureChoice, watch: Callable[[], None] = lambda: None
) -> list[DescribedSet]:
    """Describe sets of images with ``features``, and recordings with the places of the robot's front end.

    Raises:
        EvaluationError: a set cannot be read, or two have one name.
        FeatureError: an image or its features cannot be read.
        SourceError: a recording cannot be read.
    """
    described: dict[str, DescribedSet] = {}
    for path in paths:
        if path.is_file():
            each = describe_recording(path)
            watch()
        else:
            each = describe_images(read_place_set(path, labels), path, features, watch)
        if each.place_set.name in described:
            raise EvaluationError(f"{path}: there is another set {each.place_set.name}; rename one")
        described[each.place_set.name] = each
    return list(described.values())


def describe_images(
    place_set: PlaceSet, root: Path, features: FeatureChoice, watch: Callable[[], None] = lambda: None
) -> DescribedSet:
    """Describe every image of a set once.

    Raises:
        FeatureError: an image or its features cannot be read.
    """
    found: dict[Path, PlaceFeatures] = {}
    for path in all_images(place_set):
        found[path] = features.of(path, root)
        watch()
    queries, gallery = ([found[path] for path in paths] for paths in (place_set.queries, place_set.gallery))
    return DescribedSet(place_set, queries, gallery, epipolar_inliers)


def describe_training(
    folders: Sequence[Path], features: FeatureChoice, watch: Callable[[], None] = lambda: None
) -> list[Codes]:
    """Descriptors (N, 32) of every image in the folders and their subfolders.

    Raises:
        FeatureError: a folder has no image, or one cannot be read.
    """
    descriptors: list[Codes] = []
    for folder in folders:
        images = [path for path in find_files(folder) if path.suffix.lower() in _IMAGES]
        if not images:
            raise FeatureError(f"{folder}: no image in it; name a folder of JPEG, PNG, PPM or TIFF")
        for path in images:
            descriptors.append(features.of(path, folder).descriptors)
            watch()
    return descriptors


def _places(features: ImageFeatures) -> PlaceFeatures:
    return PlaceFeatures(features.keypoints_px, features.descriptors)
