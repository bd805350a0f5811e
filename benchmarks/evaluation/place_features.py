"""Scorers of the place evaluation: the fleet's place index with each strategy, and baselines.

Each computes similarities (Q, G) of queries and gallery; 0 if a place is not retrieved or not admitted.
"""

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from fcslam.cloud.cloud import Cloud
from fcslam.cloud.settings import FleetConfig
from fcslam.compiled import njit
from fcslam.errors import FeatureError, InputError
from fcslam.features.classical import Orb
from fcslam.features.codes import LARGEST_HAMMING, code_words, hamming_matrix, mutual_matches
from fcslam.features.detector import FeatureDetector, ImageFeatures, OnnxConfig, OnnxDetector
from fcslam.features.detector_kinds import DetectorKind
from fcslam.features.files import extract, find_files, read_grey
from fcslam.lidar.lost import LostConfig
from fcslam.places.index import PlaceIndex
from fcslam.places.kmeans_tree import Tree, TreeShape, find_leaves, grow_tree
from fcslam.places.motions import rigid_hypotheses
from fcslam.places.similarity import BagOfWords
from fcslam.places.vocabulary import Strategy, VocabularyConfig
from fcslam.records import CODE_BYTES, Channel, Codes, FloatArray, Keyscan, Place, frozen
from fcslam.robot.frontend import RobotConfig, RobotFrontend
from fcslam.sources import open_source
from fcslam.untrusted import read_arrays
from fcslam.wire.messages import Packet
from fcslam.wire.packets import encode

from .matching import mutual_pairs
from .place_sets import PlaceSet, all_images, read_place_set
from .retrieval import PairTruth, excluding_recent

EXTRACTED: Final = ("keypoints", "scores", "descriptors", "image_size")
"""Arrays of a file that `fcslam tools extract`, or another program, writes for an image."""
BRUTE_FORCE_BITS: Final = 48
"""Largest Hamming distance of matching descriptors."""
BRUTE_FORCE, FOREIGN_TREE = "brute force", "foreign tree"
FOREIGN_SHAPE: Final = TreeShape(branching=10, depth=4, smallest_split=2, iterations=8)
"""The usual tree of DBoW2: 10 children, 4 levels."""


@dataclass(frozen=True, slots=True)
class PlaceFeatures:
    """Features of a place."""

    positions: NDArray[np.float32]
    """Shape (N, 2): pixels of an image, or metres in the coordinate frame of a submap."""
    descriptors: Codes
    """Shape (N, 32)."""


@dataclass(frozen=True, slots=True)
class DescribedSet:
    """A set of places with the features of each."""

    place_set: PlaceSet
    queries: Sequence[PlaceFeatures]
    gallery: Sequence[PlaceFeatures]
    count_inliers: Callable[[PlaceFeatures, PlaceFeatures], int]
    """Geometric verification: number of inliers of two places."""


Scorer = Callable[[DescribedSet], FloatArray]


def brute_force(described: DescribedSet) -> FloatArray:
    """Number of mutual nearest neighbours at most 48 bits apart, for all admitted pairs: shape (Q, G)."""
    scores = np.zeros(described.place_set.admitted.shape)
    for q, g in np.argwhere(described.place_set.admitted):
        scores[q, g] = matching_descriptors(described.queries[q].descriptors, described.gallery[g].descriptors)
    return scores


def matching_descriptors(a: Codes, b: Codes) -> float:
    """Number of mutual nearest neighbours at most 48 bits apart of descriptors (N, 32) and (M, 32)."""
    return float(len(mutual_matches(a, b, BRUTE_FORCE_BITS).pairs))


def bag_of_words(words: NDArray[np.int64], idf: FloatArray, vocabulary_version: int) -> BagOfWords:
    """Compute the tf-idf vector of a place.

    ``words`` (N,) are those of every descriptor, ``idf`` the inverse document frequency of every word of the
    vocabulary.
    """
    present, counts = np.unique(words, return_counts=True)
    weights = counts * idf[present]
    telling = weights > 0.0
    total = weights[telling].sum()
    values = weights[telling] / total if total > 0.0 else np.empty(0)
    return BagOfWords(frozen(present[telling], np.int64), frozen(values), vocabulary_version)


class PretrainedVocabulary:
    """Bags of words as in DBoW2: a tree and idf weights trained offline on other images, which never change."""

    def __init__(self, training: Sequence[Codes], seed: int) -> None:
        """Train the tree on the descriptors (N, 32) of each training image."""
        images = [code_words(codes) for codes in training]
        self._tree: Tree = grow_tree(np.concatenate(images), FOREIGN_SHAPE, np.uint64(seed))
        documents = np.zeros(len(self._tree.centres))
        for codes in images:
            documents[np.unique(find_leaves(self._tree, codes))] += 1.0
        self._idf = np.log(len(images) / np.maximum(documents, 1.0))

    @property
    def word_count(self) -> int:
        """Number of leaves."""
        return int((self._tree.child_count == 0).sum())

    def bag(self, descriptors: Codes) -> BagOfWords:
        """Bag of words of descriptors (N, 32)."""
        return bag_of_words(find_leaves(self._tree, code_words(descriptors)).astype(np.int64), self._idf, 0)

    def __call__(self, described: DescribedSet) -> FloatArray:
        """L1 scores of DBoW2, shape (Q, G): sum of min over the words."""
        bags = [self.bag(place.descriptors) for place in described.gallery]
        ends = np.cumsum([0, *(len(bag.words) for bag in bags)])
        words, values = (np.concatenate(parts) for parts in zip(*((b.words, b.values) for b in bags), strict=True))
        scores = np.zeros(described.place_set.admitted.shape)
        for q, query in enumerate(described.queries):
            bag, dense = self.bag(query.descriptors), np.zeros(len(self._idf))
            dense[bag.words] = bag.values
            scores[q] = _common(dense, ends, words, values)
        return np.where(described.place_set.admitted, scores, 0.0)


def strategy_scorer(config: VocabularyConfig, seed: int) -> Scorer:
    """Scorer of the fleet's place index: places arrive in the order of the set, and queries see the admitted ones."""

    def score(described: DescribedSet) -> FloatArray:
        index: PlaceIndex[int] = PlaceIndex(config, np.random.default_rng(seed))
        return index_scores(index, described)

    return score


def index_scores(index: PlaceIndex[int], described: DescribedSet) -> FloatArray:
    """Add the gallery to ``index`` and query it: shape (Q, G). A stream queries each place before it is added."""
    admitted = described.place_set.admitted
    count = admitted.shape[1]
    scores = np.zeros(admitted.shape)

    def ask(q: int) -> None:
        barred = {int(g) for g in np.flatnonzero(~admitted[q])}
        for place, similarity in index.query(described.queries[q].descriptors, count, barred):
            scores[q, place] = similarity

    online = described.place_set.is_online
    for g, place in enumerate(described.gallery):
        if online:
            ask(g)
        index.add(g, place.descriptors)
    if not online:
        for q in range(len(described.queries)):
            ask(q)
    return scores


def choose_scorers(
    strategies: Sequence[Strategy], vocabulary: VocabularyConfig, training: Sequence[Codes], seed: int
) -> Mapping[str, Scorer]:
    """Brute force, the pretrained vocabulary if there are training images, and the index with each strategy."""
    scorers: dict[str, Scorer] = {BRUTE_FORCE: brute_force}
    if training:
        scorers[FOREIGN_TREE] = PretrainedVocabulary(training, seed)
    for strategy in strategies:
        scorers[strategy] = strategy_scorer(vocabulary.model_copy(update={"strategy": strategy}), seed)
    return scorers


@njit
def _common(query: FloatArray, ends: NDArray[np.int64], words: NDArray[np.int64], values: FloatArray) -> FloatArray:
    """Sum of min(query, place) for every place, whose words and values are from ``ends[k]`` to ``ends[k + 1]``."""
    scores = np.zeros(len(ends) - 1)
    for place in range(len(ends) - 1):
        for entry in range(ends[place], ends[place + 1]):
            scores[place] += min(query[words[entry]], values[entry])
    return scores


RATIO: Final = 0.9
"""Ratio test (Lowe 2004): largest ratio of the nearest to the second nearest distance."""
ACCEPTED_INLIERS: Final = 20
"""Inliers at which the verified similarity is 0.5."""
CANDIDATES: Final = 50
"""Most similar places of a query that are verified."""
_EPIPOLAR_PX = 1.5
"""Largest epipolar error of an inlier."""
_FEWEST = 8
"""Fewest matches for a fundamental matrix."""
_TRIALS = 1000
"""Most iterations of MAGSAC++."""
_CONFIDENCE = 0.999


class PairVerifier:
    """Verifies pairs of a set and caches the results."""

    def __init__(self, described: DescribedSet) -> None:
        self._described = described
        self._inliers: dict[tuple[int, int], int] = {}

    def verified(self, similarity: FloatArray, candidates: int = CANDIDATES) -> FloatArray:
        """Verified similarity inliers / (inliers + 20) of the most similar places of every query, else 0: shape (Q, G).

        A pair with at least 0.5 is accepted. ``candidates``: places of a query that are verified.
        """
        verified = np.zeros(similarity.shape)
        for q, row in enumerate(similarity):
            best = np.argsort(-row, kind="stable")[:candidates]
            for g in best[row[best] > 0.0]:
                inliers = self.inliers(q, int(g))
                verified[q, g] = inliers / (inliers + ACCEPTED_INLIERS)
        return verified

    def inliers(self, query: int, place: int) -> int:
        """Number of inliers of a pair."""
        if (query, place) not in self._inliers:
            pair = self._described.queries[query], self._described.gallery[place]
            self._inliers[query, place] = self._described.count_inliers(*pair)
        return self._inliers[query, place]


def epipolar_inliers(a: PlaceFeatures, b: PlaceFeatures) -> int:
    """Number of inliers of the fundamental matrix between two images; it also covers planar scenes."""
    first, second = distinct_matches(a, b)
    if len(first) < _FEWEST:
        return 0
    cv2.setRNGSeed(0)
    try:
        _, mask = cv2.findFundamentalMat(first, second, cv2.USAC_MAGSAC, _EPIPOLAR_PX, _CONFIDENCE, _TRIALS)
    except cv2.error:  # no model, for example for matches on a line
        return 0
    return 0 if mask is None else int(mask.sum())


def distinct_matches(a: PlaceFeatures, b: PlaceFeatures) -> tuple[FloatArray, FloatArray]:
    """Positions of mutual nearest neighbours that pass the ratio test, pixels, shape (K, 2) each."""
    if min(len(a.descriptors), len(b.descriptors)) < 2:
        return np.empty((0, 2)), np.empty((0, 2))
    distances = hamming_matrix(a.descriptors, b.descriptors)
    pairs = mutual_pairs(distances.argmin(axis=1), distances.argmin(axis=0))
    nearest = np.partition(distances[pairs[:, 0]], 1, axis=1)[:, :2].astype(np.float64)
    kept = pairs[nearest[:, 0] < RATIO * nearest[:, 1]]
    return a.positions[kept[:, 0]].astype(np.float64), b.positions[kept[:, 1]].astype(np.float64)


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


def read_features(path: Path) -> tuple[ImageFeatures, tuple[int, int]]:
    """Read features, the strongest first, and the width and height of their image in pixels.

    Raises:
        FeatureError: the file cannot be read, or is not of this format.
    """
    try:
        archive = read_arrays(path)
        keypoints, scores, descriptors, size = (archive[name] for name in EXTRACTED)
    except (OSError, ValueError, KeyError) as error:
        raise FeatureError(f"{path}: cannot read the features ({error}); write {', '.join(EXTRACTED)}") from error
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


def choose_features(choice: str) -> FeatureChoice:
    """Choose features by a detector's name, an .onnx file, or a folder of extracted features.

    Raises:
        FeatureError: ``choice`` is no detector, .onnx file or folder, or the network cannot be used.
    """
    path = Path(choice)
    if choice == DetectorKind.ORB:
        return FeatureChoice(choice, Orb(most_features=FEATURES_PER_IMAGE, fast_threshold=FAST_THRESHOLD))
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
        InputError: a set cannot be read, or two have one name.
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
            raise InputError(f"{path}: there is another set {each.place_set.name}; rename one")
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


SAME_M: Final = 1.0
"""Largest distance of a match."""
OTHER_M: Final = 10.0
"""Smallest distance of different places; closer submaps overlap."""
REVISIT_S: Final = 60.0
"""Places newer than this are not retrieved."""


def describe_recording(recording: Path) -> DescribedSet:
    """Describe all LiDAR places of a recording.

    A match is within 1 m, a different place more than 10 m away; both are at least 60 s older than the query.

    Raises:
        SourceError: the recording cannot be read.
        InputError: the recording has fewer than two places.
    """
    source = open_source(recording)
    config = RobotConfig(channels=(Channel.LIDAR,), lost=LostConfig(doubted=0.0))  # one session, whatever happens
    robot = RobotFrontend(source.name, config)
    packets: list[Packet] = []
    for record in source.records():
        packets += robot.process(record)
    packets += robot.finish()
    places = [packet.body for packet in packets if isinstance(packet.body, Place)]
    if len(places) < 2:
        raise InputError(f"{recording}: nothing to compare, {len(places)} place in it; give a longer recording")
    stamps = {packet.body.id: packet.body.stamp for packet in packets if isinstance(packet.body, Keyscan)}
    poses = _corrected(packets)[[place.id.number for place in places]]

    apart_m = np.linalg.norm(poses[:, None, :2] - poses[:, :2], axis=2)
    seen = np.array([stamps[place.id] for place in places])
    admitted = excluding_recent(seen, REVISIT_S)
    truth = PairTruth(admitted & (apart_m <= SAME_M), admitted & (apart_m > OTHER_M))
    names = tuple(Path(source.name, str(place.id.number)) for place in places)
    features = [PlaceFeatures(place.keypoints, place.descriptors) for place in places]
    return DescribedSet(
        PlaceSet(source.name, names, names, admitted, {"revisits": truth}), features, features, planar_inliers
    )


def planar_inliers(a: PlaceFeatures, b: PlaceFeatures) -> int:
    """Number of inliers of the best rigid motion between two LiDAR places."""
    matches = mutual_matches(a.descriptors, b.descriptors, LARGEST_HAMMING)
    found = rigid_hypotheses(a.positions, b.positions, matches)
    return len(found[0][1]) if found else 0


def _corrected(packets: list[Packet]) -> FloatArray:
    """Optimized poses of all keyscans, shape (N, 3)."""
    cloud = Cloud(FleetConfig(join_maps=False), 0)
    for packet in packets:
        cloud.receive(encode(packet))
    return cloud.finalize().robots[0].T_map_base
