"""Place recognition: what the order of a stream adds to the similarities of the incremental index.

    FCSLAM_DATA=/path/to/data python benchmarks/place_sequences.py

NSS: similarity as a share of that with the robot's own previous place. 3 in a row: only matches whose two predecessors
matched places at most one apart. along 3: mean similarity of three consecutive places with three consecutive ones, in
either direction. Both scores of the index: matches, the default, and words, eq. (4). Images by 500 features of 400
pixels; LiDAR as in benchmarks/places.py. Each query answers with its most similar place; recall at as many as the
fleet has candidates is what the fleet profits from. In brackets: 95 % by bootstrap over queries.
"""

from collections.abc import Iterator

import common

from fcslam.lab.evaluation.places.features import FeatureChoice, choose_features, describe_sets
from fcslam.lab.evaluation.places.report import evaluate_set
from fcslam.lab.evaluation.places.scoring import DescribedSet, strategy_scorer
from fcslam.lab.evaluation.places.sequences import in_sequence
from fcslam.metrics.bootstrap import Interval
from fcslam.metrics.retrieval import recall_at
from fcslam.places.matcher import MatcherConfig
from fcslam.places.vocabulary import Scoring, VocabularyConfig

STREAMS = ("rtabmap_corridor", "tum_rgbd/freiburg1_rpy")
CANDIDATES = MatcherConfig().candidates
SEED = 1


def main() -> None:
    chosen = common.options(__doc__ or "").parse_args()
    report = common.Report(__file__, __doc__ or "", chosen)
    images = common.recordings(*STREAMS, kind="vision")
    logs = common.recordings(*common.slam_benchmark_files())
    for name in ("orb", "onnx"):
        features = choose_features(name)
        for described in describe_sets([images / stream for stream in STREAMS], (), features):
            _tell(report, features.name, described)
    for described in describe_sets([common.log_path(logs, log) for log in common.SPLITS], (), FeatureChoice("", None)):
        _tell(report, "LiDAR", described)
    report.write()


def _tell(report: common.Report, features: str, described: DescribedSet) -> None:
    columns = {"": "s", "R@1": "s", f"R@{CANDIDATES}": ".3f", "AP": "s", "R at 100 % precision": ".3f"}
    report.table(f"{features}: {described.place_set.name}", columns, _rows(described))


def _rows(described: DescribedSet) -> Iterator[tuple[object, ...]]:
    scorers = {scoring.value: strategy_scorer(VocabularyConfig(scoring=scoring), SEED) for scoring in Scoring}
    result = evaluate_set(described, scorers, None, SEED, variants=in_sequence)
    (truth,) = described.place_set.questions.values()
    for score in result.scores:
        value = score.measures
        yield (
            score.scorer,
            _shown(value["recall_at_1"]),
            float(recall_at(result.similarities[score.scorer], truth, CANDIDATES).mean()),
            _shown(value["average_precision"]),
            value["recall_at_full_precision"].mean,
        )


def _shown(value: Interval) -> str:
    return f"{value.mean:.3f} [{value.low:.2f}, {value.high:.2f}]"


if __name__ == "__main__":
    main()
