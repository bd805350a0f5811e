"""Place recognition: the fleet's index beside brute force and a fixed tree of other images, as DBoW users have it.

    FCSLAM_DATA=/path/to/data python benchmarks/places.py --fleets FLEET ...

500 features on grey images of 400 pixels; each query answers with its most similar place. Trees of other images are
trained on photographs and street scenes (k=10, L=4). The network learned from other floors of the tower, so it is
judged on floors 11 to 15 only, and ORB there as well. Places look alike from floor to floor: `near` asks for the right
one among all, which appearance cannot tell. Verified: the 50 most similar places of each query, ranked by how many
matches one fundamental matrix explains. rebuild is left out: it would take hours; benchmarks/figure4.py
has it. In brackets: 95 % by bootstrap over queries. LiDAR: places of one robot against those at least 60 s older, 1 m
or less away by its own corrected poses; different is more than 10 m away. FLEET: folders that `fcslam tools simulate`
recorded, places of each robot against those of robots before it, by how much their views overlap; left out if none is
given.
"""

from collections.abc import Iterator, Sequence
from pathlib import Path

import common
from evaluation.place_features import (
    DescribedSet,
    FeatureChoice,
    PairVerifier,
    choose_features,
    choose_scorers,
    describe_sets,
    describe_training,
)
from evaluation.places import SetResult, curves_figure, evaluate_set

from fcslam.metrics.bootstrap import Interval
from fcslam.places.vocabulary import Strategy, VocabularyConfig
from fcslam.records import Codes

TRAINING = ("bsds500", "coco_subset", "urban100", "sun_hays80", "kodak24", "camvid")
CORRIDOR, DESK, TOWER = "rtabmap_corridor", "tum_rgbd/freiburg1_rpy", "ie_tower"
UNSEEN_FLOORS = [f"floor{number}" for number in range(11, 16)]
SEED = 1


def main() -> None:
    parser = common.options(__doc__ or "")
    parser.add_argument("--features", nargs="+", default=["orb", "onnx"], help="orb, onnx, .onnx files, folders")
    parser.add_argument("--fleets", nargs="*", type=Path, default=[], help="recorded by fcslam tools simulate")
    parser.add_argument("--no-lidar", action="store_true", help="images only")
    chosen = parser.parse_args()
    report = common.Report(__file__, __doc__ or "", chosen)
    images = common.recordings(CORRIDOR, DESK, TOWER, *TRAINING, kind="vision")
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


def _shown(value: Interval) -> str:
    return f"{value.mean:.3f} [{value.low:.2f}, {value.high:.2f}]"


if __name__ == "__main__":
    main()
