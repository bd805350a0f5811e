"""Training on places that were seen again in real recordings: places and homographies before and after.

    FCSLAM_DATA=/path/to/data python benchmarks/closure_learning_real.py

Two recordings, each split in time: training sees the earlier part and the test the later one.

- desk: freiburg1_rpy of TUM RGB-D. Depth and measured poses tell where an image shows the keypoints of another one; the
  first 60 % of the time train. Views of a pair overlap by 0.2 or more and are a second or more apart.
- corridor: 84 images of an office loop that was walked twice. It has no poses, so inliers of SIFT under one fundamental
  matrix tell where a keypoint is, by the median shift of the nearest five. Listed loop pairs up to the images 22 and 62
  train; the test has the images of both passes after these.

From there all is as on a robot: like codes correct the predicted pixels, and the nearest keypoint within 2 px is the
same point (`learning/revisits.py`). The settings are the defaults of `fcslam serve --learn`. Each robot trains alone,
and both train federated.

Places: 500 features of images of 400 px, candidates from the incremental vocabulary, verified by one fundamental
matrix, as in `benchmarks/places.py`. Inliers: mean over the pairs of one place in the test, whatever was retrieved,
above the bundled network, with 95 % intervals by bootstrap over pairs. The tower (floors 11 to 15) and the 25
photographs of `benchmarks/homography.py` show what is forgotten.
"""

import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import common
import cv2
import numpy as np
from closure_learning import FORGETTING, Learner, federated, photograph_rows, ranked, trained_here
from evaluation.place_features import (
    DescribedSet,
    FeatureChoice,
    PairVerifier,
    choose_features,
    describe_images,
    strategy_scorer,
)
from evaluation.place_sets import PlaceSet, read_place_set
from evaluation.places import evaluate_set
from evaluation.retrieval import PairTruth
from evaluation.view_overlap import DEPTH_AGREEMENT, read_sequence, view_overlap
from evaluation.view_overlap import Sequence as TumSequence

from fcslam.features.detector import BUNDLED_NETWORK, ImageFeatures, OnnxConfig, OnnxDetector
from fcslam.features.files import read_grey
from fcslam.learning.code_batches import RevisitExamples, RevisitPair
from fcslam.learning.export import export_onnx
from fcslam.learning.federated.initial_weights import prepare_initial_weights
from fcslam.learning.federated.settings import LIVE_ROUNDS
from fcslam.learning.labels import Labels
from fcslam.learning.pairs import TrainingExample
from fcslam.learning.revisits import BORDER_PX, FEWEST_SHARED, correspond_predicted
from fcslam.metrics.bootstrap import Interval, mean_interval
from fcslam.places.vocabulary import VocabularyConfig
from fcslam.records import FloatArray

DESK, CORRIDOR, TOWER = "tum_rgbd/freiburg1_rpy", "rtabmap_corridor", "ie_tower"
UNSEEN_FLOORS = [f"floor{number}" for number in range(11, 16)]
TRAINED_SHARE = 0.6
"""Share of the desk's time that trains."""
TRAINED_PAIRS = (22, 62)
"""Numbers of the last images of the corridor, of both passes, that train."""
EVERY = 2
"""One of so many images of the desk trains; the camera hardly moves between two."""
PAIR_OVERLAP, PAIR_GAP_S = 0.2, 1.0
FEWEST_SIFT, SIFT_RATIO, SIFT_PX, SIFT_NEAREST, SIFT_REACH_PX = 20, 0.8, 2.0, 5, 40.0
SEED = 1
PLACES = {"network": "", "pairs of one place": "d", "inliers a pair": ".1f", "above bundled": "", "AP, verified": "",
          "R@1, verified": "", "R at 100 % precision, verified": ".3f"}  # fmt: skip


@dataclass(frozen=True, slots=True, eq=False)
class Predicted:
    """Where the second of two images shows the keypoints of the first one."""

    i: int
    j: int
    pixels: FloatArray
    shown: np.ndarray


def main() -> None:
    parser = common.options(__doc__ or "")
    parser.add_argument("--networks", type=Path, help="folder in which trained networks are kept")
    chosen = parser.parse_args()
    report = common.Report(__file__, __doc__ or "", chosen)
    vision = common.recordings(DESK, CORRIDOR, TOWER, kind="vision")
    learners = {"desk": desk(vision / DESK), "corridor": corridor(vision / CORRIDOR)}
    columns = {"robot": "", "images": "d", "pairs": "d", "points": "d"}
    counts = [(name, len(each.keyframes), len(each.pairs), sum(len(p.positions) for p in each.pairs))
              for name, each in learners.items()]  # fmt: skip
    report.table("Examples", columns, counts)
    with tempfile.TemporaryDirectory() as place:
        networks = trained(learners, (chosen.networks or Path(place)) / common.commit())
        for name, place_set, root in test_sets(vision):
            report.table(name, PLACES, place_rows(place_set, root, networks))
        rows = [photograph_rows(name, SEED, [path])[0] for name, path in networks.items()]
    report.table("Photographs of other places", FORGETTING, rows)
    report.write()


def trained(learners: Mapping[str, Learner], folder: Path) -> dict[str, Path]:
    """The bundled network, that of each robot alone, and that of both."""
    training = LIVE_ROUNDS.training.model_copy(update={"seed": SEED})
    rounds = LIVE_ROUNDS.model_copy(update={"training": training})
    networks = {"bundled": BUNDLED_NETWORK}
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as place:
        start = prepare_initial_weights(BUNDLED_NETWORK, Path(place), training.encoder)
        for name, learner in learners.items():
            revisits = RevisitExamples([each.image for each in learner.keyframes], learner.pairs)
            steps = rounds.rounds * rounds.local_steps
            networks[f"{name}, alone"] = exported(
                folder / f"{name}.onnx",
                lambda r=revisits, s=steps: trained_here(start, r, rounds, SEED, s),  # type: ignore[misc]
            )
        both = [(number, learner) for number, learner in enumerate(learners.values())]
        networks["both, federated"] = exported(
            folder / "both.onnx", lambda: federated("own map", SEED, both, start, rounds, Path(place))
        )
    return networks


def exported(path: Path, train: Callable) -> Path:
    """The network at a path, trained now unless it is there."""
    if not path.exists():
        print(f"training {path.name}", file=sys.stderr, flush=True)
        export_onnx(train(), path)
    return path


def desk(folder: Path) -> Learner:
    """The earlier part of the desk; depth and poses predict the keypoints."""
    whole = read_sequence(folder)
    rows = np.flatnonzero(earlier(whole.stamps))[::EVERY]
    sequence = replace(
        whole, images=tuple(whole.images[row] for row in rows), stamps=whole.stamps[rows],
        depths_m=whole.depths_m[rows], T_world_camera=whole.T_world_camera[rows],
    )  # fmt: skip
    features = [described(path) for path in sequence.images]
    overlap = view_overlap(sequence.depths_m, sequence.T_world_camera, sequence.camera)
    apart = np.abs(np.subtract.outer(sequence.stamps, sequence.stamps)) >= PAIR_GAP_S
    pairs = np.argwhere(np.triu((overlap >= PAIR_OVERLAP) & apart, 1))
    predicted = (projected(sequence, i, j, features[i]) for i, j in pairs.tolist())
    return learner("desk", sequence.images, features, predicted)


def earlier(stamps: FloatArray) -> np.ndarray:
    """Which times belong to the part that trains."""
    return stamps < stamps[0] + TRAINED_SHARE * (stamps[-1] - stamps[0])


def projected(sequence: TumSequence, i: int, j: int, features: ImageFeatures) -> Predicted:
    """By depth, both poses and the lens."""
    scale = read_grey(sequence.images[i]).shape[1] / sequence.depths_m.shape[2]
    fx, fy, cx, cy = sequence.camera.intrinsics
    K = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    pixels = features.keypoints_px.astype(np.float64) / scale
    depth = at(sequence.depths_m[i], pixels)
    rays = cv2.undistortPoints(pixels[:, None], K, sequence.camera.distortion)[:, 0]
    points = np.column_stack((rays, np.ones(len(rays)), 1.0 / np.maximum(depth, 1e-3))) * depth[:, None]
    there = points @ (np.linalg.inv(sequence.T_world_camera[j]) @ sequence.T_world_camera[i]).T
    in_front = np.maximum(there[:, 2:3], 1e-3)
    found = cv2.projectPoints(there[:, :3] / in_front, np.zeros(3), np.zeros(3), K, sequence.camera.distortion)[0][:, 0]
    seen = at(sequence.depths_m[j], found)
    visible = np.abs(seen - there[:, 2]) <= DEPTH_AGREEMENT * there[:, 2]
    return Predicted(i, j, found * scale, (depth > 0.0) & (there[:, 2] > 0.0) & (seen > 0.0) & visible)


def at(image: FloatArray, pixels: FloatArray) -> FloatArray:
    """Values at the nearest pixels (N, 2); 0 near the border and outside."""
    height, width = image.shape
    x, y = np.nan_to_num(np.rint(pixels), nan=-1.0).clip(-1, [width, height]).astype(np.int64).T
    inside = (x >= BORDER_PX) & (x < width - BORDER_PX) & (y >= BORDER_PX) & (y < height - BORDER_PX)
    return np.where(inside, image[y.clip(0, height - 1), x.clip(0, width - 1)], 0.0)


def corridor(folder: Path) -> Learner:
    """The earlier parts of both passes; SIFT predicts the keypoints."""
    pairs = trained_pairs(folder)
    numbers = sorted(set(pairs.ravel().tolist()))
    images = [folder / f"{number:03}.jpg" for number in numbers]
    features = [described(path) for path in images]
    rows = np.searchsorted(numbers, pairs)
    predicted = (by_sift(images, i, j, features[i]) for i, j in rows.tolist())
    return learner("corridor", images, features, (each for each in predicted if each is not None))


def trained_pairs(folder: Path) -> np.ndarray:
    """Numbers of the images of the corridor's pairs that train, shape (N, 2)."""
    pairs = np.loadtxt(folder / "loop_pairs.txt", dtype=np.int64, usecols=(0, 1), ndmin=2)
    return pairs[(pairs <= TRAINED_PAIRS).all(axis=1)]


def by_sift(images: Sequence[Path], i: int, j: int, features: ImageFeatures) -> Predicted | None:
    """By the median shift of the nearest inliers; None if there are few."""
    sift = cv2.SIFT_create()
    (a, codes_a), (b, codes_b) = (sift.detectAndCompute(read_grey(images[k]), None) for k in (i, j))
    best = [m for m, n in cv2.BFMatcher().knnMatch(codes_a, codes_b, k=2) if m.distance < SIFT_RATIO * n.distance]
    first = np.array([a[m.queryIdx].pt for m in best])
    second = np.array([b[m.trainIdx].pt for m in best])
    if len(best) < FEWEST_SIFT:
        return None
    cv2.setRNGSeed(0)
    mask = cv2.findFundamentalMat(first, second, cv2.USAC_MAGSAC, SIFT_PX)[1]
    if mask is None or mask.sum() < FEWEST_SIFT:
        return None
    inlier = mask.ravel().astype(bool)
    gaps = np.linalg.norm(features.keypoints_px[:, None] - first[inlier][None], axis=2)
    nearest = np.argsort(gaps, axis=1)[:, :SIFT_NEAREST]
    shift = np.median((second - first)[inlier][nearest], axis=1)
    return Predicted(i, j, features.keypoints_px + shift, np.sort(gaps, axis=1)[:, SIFT_NEAREST - 1] <= SIFT_REACH_PX)


@cache
def detector() -> OnnxDetector:
    return OnnxDetector(OnnxConfig())


def described(path: Path) -> ImageFeatures:
    return detector().detect(read_grey(path))


def learner(
    name: str, images: Sequence[Path], features: Sequence[ImageFeatures], predicted: Iterator[Predicted]
) -> Learner:
    """Images with their pairs; without positions in a map."""
    pairs = []
    for each in predicted:
        rows = correspond_predicted(features[each.i], features[each.j], each.pixels, each.shown)
        if len(rows) >= FEWEST_SHARED:
            points = (features[k].keypoints_px[column] for k, column in zip((each.i, each.j), rows.T, strict=True))
            pairs.append(RevisitPair((each.i, each.j), tuple(points), np.full((len(rows), 3), np.nan)))
    examples = tuple(
        TrainingExample(read_grey(path), Labels(found.keypoints_px, ranked(len(found.scores))))
        for path, found in zip(images, features, strict=True)
    )
    return Learner(name, examples, tuple(pairs))


def test_sets(vision: Path) -> Iterator[tuple[str, PlaceSet, Path]]:
    """The later parts of both recordings, and the tower."""
    later = ~earlier(read_sequence(vision / DESK).stamps)
    yield "desk, later part", restricted(read_place_set(vision / DESK), later, later), vision / DESK
    tour = read_place_set(vision / CORRIDOR)
    numbers, trained = np.array([int(path.stem) for path in tour.queries]), np.unique(trained_pairs(vision / CORRIDOR))
    first, second = TRAINED_PAIRS
    is_new = (numbers > first) & ~np.isin(numbers, trained)
    yield (
        "corridor, later part",
        restricted(tour, numbers > second, is_new),
        vision / CORRIDOR,
    )
    tower = read_place_set(vision / TOWER, UNSEEN_FLOORS)
    question = "within a floor"
    yield "tower, floors 11 to 15", replace(tower, questions={question: tower.questions[question]}), vision / TOWER


def restricted(place_set: PlaceSet, queries: np.ndarray, gallery: np.ndarray) -> PlaceSet:
    """The same images, but only pairs of these queries and these earlier images are asked for."""
    asked = queries[:, None] & gallery
    questions = {
        name: PairTruth(truth.matches & asked, truth.different & asked) for name, truth in place_set.questions.items()
    }
    return replace(place_set, admitted=place_set.admitted & asked, questions=questions)


def place_rows(place_set: PlaceSet, root: Path, networks: Mapping[str, Path]) -> Iterator[tuple]:
    """Each network on one set."""
    (question,) = place_set.questions.values()
    bundled: FloatArray = np.empty(0)
    for name, path in networks.items():
        features: FeatureChoice = choose_features(str(path))
        described_set: DescribedSet = describe_images(place_set, root, features)
        verifier = PairVerifier(described_set)
        inliers = np.array([verifier.inliers(q, g) for q, g in np.argwhere(question.matches).tolist()], np.float64)
        bundled = inliers if name == "bundled" else bundled
        gap = mean_interval(inliers - bundled, np.random.default_rng(SEED))
        scorers = {"incremental": strategy_scorer(VocabularyConfig(), SEED)}
        (score,) = (s for s in evaluate_set(described_set, scorers, verifier, SEED).scores if s.is_verified)
        found = score.measures
        yield (
            name, len(inliers), float(inliers.mean()), shown(gap, "+.1f"),
            shown(found["average_precision"]), shown(found["recall_at_1"]),
            found["recall_at_full_precision"].mean,
        )  # fmt: skip


def shown(value: Interval, spec: str = ".3f") -> str:
    return f"{value.mean:{spec}} [{value.low:{spec}}, {value.high:{spec}}]"


if __name__ == "__main__":
    main()
