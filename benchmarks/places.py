"""Place recognition: the fleet's index beside brute force and a fixed tree of other images, as DBoW users have it.

    FCSLAM_DATA=/path/to/data python benchmarks/places.py --fleets FLEET ...
    FCSLAM_DATA=/path/to/data python benchmarks/places.py --gate OTHER.onnx ... --results gate

500 features on grey images of 400 pixels; each query answers with its most similar place. Trees of other images are
trained on photographs and street scenes (k=10, L=4). The network learned from other floors of the tower, so it is
judged on floors 11 to 15 only, and ORB there as well. Places look alike from floor to floor: `near` asks for the right
one among all, which appearance cannot tell. Verified: the 50 most similar places of each query, ranked by how many
matches one fundamental matrix explains. rebuild is left out: it would take hours; benchmarks/figure4.py
has it. In brackets: 95 % by bootstrap over queries. LiDAR: places of one robot against those at least 60 s older, 1 m
or less away by its own corrected poses; different is more than 10 m away. FLEET: folders that `fcslam tools simulate`
recorded, places of each robot against those of robots before it, by how much their views overlap; left out if none is
given.

--gate compares the bundled network with others, and says nothing else: by the fleet's index on the corridor, the desk
and floors 11 to 15, where each image is a query for all others. The 20 most similar places are verified, as many as a
fleet verifies. Differences are those of the bundled network less the other one, paired, with 95 % by bootstrap over
blocks of ten consecutive queries. Found is the share of queries with a match among those that are verified; the last
row verifies more places of the bundled network. A network may take the place of another one if in each set the
interval of the average precision begins above -0.05, the limit of a fleet's releases.
"""

from collections.abc import Iterator, Sequence
from pathlib import Path

import common
import numpy as np
from evaluation.place_features import (
    DescribedSet,
    FeatureChoice,
    PairVerifier,
    choose_features,
    choose_scorers,
    describe_images,
    describe_sets,
    describe_training,
    strategy_scorer,
)
from evaluation.place_sets import read_place_set
from evaluation.places import SetResult, curves_figure, differences, evaluate_set, measure

from fcslam.features.detector_kinds import DetectorKind
from fcslam.learning.federated.evaluation import MOST_PLACES_LOST
from fcslam.metrics.bootstrap import Interval
from fcslam.places.vocabulary import Strategy, VocabularyConfig
from fcslam.records import Codes

TRAINING = ("bsds500", "coco_subset", "urban100", "sun_hays80", "kodak24", "camvid")
CORRIDOR, DESK, TOWER = "rtabmap_corridor", "tum_rgbd/freiburg1_rpy", "ie_tower"
UNSEEN_FLOORS = [f"floor{number}" for number in range(11, 16)]
SEED = 1
FLEET_CANDIDATES, MORE_CANDIDATES = 20, 50
SHOWN = ("recall_at_1", "average_precision", "recall_at_full_precision")
MEASURES = ("R@1", "AP", "R at 100 % precision")
GATE = (
    {"": "s", "found": ".3f"}
    | {f"{each}{name}": "s" for each in ("", "bundled less this: ") for name in MEASURES}
    | {"passes": "s"}
)


def main() -> None:
    parser = common.options(__doc__ or "")
    parser.add_argument("--features", nargs="+", default=["orb", "onnx"], help="orb, onnx, .onnx files, folders")
    parser.add_argument("--fleets", nargs="*", type=Path, default=[], help="recorded by fcslam tools simulate")
    parser.add_argument("--no-lidar", action="store_true", help="images only")
    parser.add_argument("--gate", nargs="+", default=[], help=".onnx files to compare the bundled network with")
    chosen = parser.parse_args()
    report = common.Report(__file__, __doc__ or "", chosen)
    images = common.recordings(CORRIDOR, DESK, TOWER, *TRAINING, kind="vision")
    if chosen.gate:
        _tell_gate(report, images, chosen.gate)
        return
    curves: list[SetResult] = []
    for name in chosen.features:
        features = choose_features(name)
        training = describe_training([images / folder for folder in TRAINING], features)
        sets = describe_sets([images / CORRIDOR, images / DESK, *chosen.fleets], (), features)
        unseen = describe_sets([images / TOWER], UNSEEN_FLOORS, features)
        results = _evaluate([*sets, *unseen], training)
        _tell(report, features.name, results, "floors 11 to 15")
        curves += results if not curves else []
        if name == "orb":
            _tell(
                report, features.name, _evaluate(describe_sets([images / TOWER], (), features), training), "all floors"
            )
    if not chosen.no_lidar:
        logs = common.recordings(*common.slam_benchmark_files())
        recordings = describe_sets([common.log_path(logs, log) for log in common.SPLITS], (), FeatureChoice("", None))
        _tell(report, "LiDAR", _evaluate(recordings, ()), "")
    report.picture("Precision over recall; dashed: verified", curves_figure(curves))
    report.write()


def _evaluate(sets: Sequence[DescribedSet], training: Sequence[Codes]) -> list[SetResult]:
    scorers = choose_scorers((Strategy.INCREMENTAL,), VocabularyConfig(), training, SEED)
    return [evaluate_set(each, scorers, PairVerifier(each), SEED) for each in sets]


def _tell(report: common.Report, features: str, results: Sequence[SetResult], floors: str) -> None:
    columns = {"": "s", "R@1": "s", "R@5": ".3f", "R@10": ".3f", "AP": "s", "R at 100 % precision": ".3f"}
    columns |= {"mismatch rate": "s", "relative significance": ".3f", "verified: R@1": ".3f", "AP ": ".3f"}
    columns |= {"R at 100 % precision ": ".3f"}
    for result in results:
        for question in result.place_set.questions:
            where = f", {floors}" if len(result.place_set.questions) > 1 else ""
            title = f"{features}: {result.place_set.name}{where}, {question}"
            report.table(title, columns, _rows(result, question))


def _rows(result: SetResult, question: str) -> Iterator[tuple[object, ...]]:
    by_stage = {(s.scorer, s.is_verified): s.measures for s in result.scores if s.question == question}
    for name in result.similarities:
        value, after = by_stage[name, False], by_stage[name, True]
        yield (
            name,
            _shown(value["recall_at_1"]),
            value["recall_at_5"].mean,
            value["recall_at_10"].mean,
            _shown(value["average_precision"]),
            value["recall_at_full_precision"].mean,
            _shown(value["mismatch_rate"]),
            value["relative_significance"].mean,
            *(after[name].mean for name in ("recall_at_1", "average_precision", "recall_at_full_precision")),
        )


def _tell_gate(report: common.Report, images: Path, others: Sequence[str]) -> None:
    """The report of the gate: each detector on each set, and the bundled network less the other ones."""
    detectors = [choose_features(name) for name in (DetectorKind.ONNX, *others, DetectorKind.ORB)]
    for folder in (CORRIDOR, DESK, TOWER):
        is_tower = folder == TOWER
        places = read_place_set(images / folder, UNSEEN_FLOORS if is_tower else (), every_image=is_tower)
        described = {each.name: describe_images(places, images / folder, each) for each in detectors}
        similar = {name: strategy_scorer(VocabularyConfig(), SEED)(each) for name, each in described.items()}
        bundled = detectors[0].name
        checked = {name: (name, FLEET_CANDIDATES) for name in described}
        checked[f"{bundled}, {MORE_CANDIDATES} verified"] = bundled, MORE_CANDIDATES
        verifiers = {name: PairVerifier(each) for name, each in described.items()}
        verified = {row: verifiers[name].verified(similar[name], most) for row, (name, most) in checked.items()}
        for question, truth in places.questions.items():
            rows = list[tuple[object, ...]]()
            for row, (name, most) in checked.items():
                values, _ = measure(verified[row], truth, np.random.default_rng(SEED))
                gains = differences(verified[bundled], verified[row], truth, np.random.default_rng(SEED))
                passes = gains["average_precision"].low > -MOST_PLACES_LOST
                shown = (*(_shown(values[each]) for each in SHOWN), *(_shown(gains[each], "+") for each in SHOWN))
                nearest = np.argsort(-similar[name], axis=1, kind="stable")[:, :most]
                found = np.take_along_axis(truth.matches, nearest, axis=1).any(axis=1)[truth.answerable]
                rows.append((row, found.mean(), *shown, "yes" if passes else "no"))
            asked = int(truth.answerable.sum())
            report.table(f"{places.name}, {question}: {asked} queries, verified", GATE, rows)
    report.write()


def _shown(value: Interval, sign: str = "") -> str:
    return f"{value.mean:{sign}.3f} [{value.low:{sign}.2f}, {value.high:{sign}.2f}]"


if __name__ == "__main__":
    main()
