"""A vocabulary that was trained in one environment and moved to another.

    FCSLAM_DATA=/path/to/data python benchmarks/moved_vocabulary.py --fleets FOLDER

The tree is grown from all places of one set; then those of the other arrive and are asked for, as in
benchmarks/places.py. `trained there`: the same tree grown from the set's own gallery. ORB, 500 features on grey images
of 400 pixels. Both ways to score: eq. (4), and the index's default, whose words only propose. `regained`: by how much
the recall at 1 is above that of the tree trained there, query by query, with 95 % by bootstrap.

`simulation`: every camera place of every fleet in FOLDER (`fcslam tools simulate --seed 101 --output
FOLDER/default-101` and so on), a metre or half a radian apart. Without --fleets these moves are left out.
"""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import common
import numpy as np
from evaluation.fleet_views import read_fleet_views
from evaluation.place_features import DescribedSet, FeatureChoice, choose_features, describe_sets, index_scores
from evaluation.place_sets import FLEET
from evaluation.retrieval import recall_at, single_best

from fcslam.metrics.bootstrap import mean_interval
from fcslam.places.index import PlaceIndex
from fcslam.places.vocabulary import Scoring, Strategy, VocabularyConfig
from fcslam.records import Codes, FloatArray

SETS = ("rtabmap_corridor", "ie_tower", "tum_rgbd/freiburg1_rpy")
MOVES = ((1, 0), (0, 1), (2, 1), (1, 2), (0, 2))
SEED = 1
FIXED = VocabularyConfig(strategy=Strategy.REBUILD, train_batch=1_000_000)
"""Never trained again after ``train``."""


class School(NamedTuple):
    """What a tree is grown from."""

    name: str
    places: Sequence[Codes]


def main() -> None:
    parser = common.options(__doc__ or "")
    parser.add_argument("--fleets", type=Path, help="folder of fleets that fcslam tools simulate recorded")
    chosen = parser.parse_args()
    report = common.Report(__file__, __doc__ or "", chosen)
    images, features = common.recordings(*SETS, kind="vision"), choose_features("orb")
    sets = describe_sets([images / name for name in SETS], (), features)
    moves = [(_gallery(sets[origin]), sets[goal]) for origin, goal in MOVES]
    if chosen.fleets is not None:
        simulation = _simulation(chosen.fleets, features)
        report.say(f"The simulation has {len(simulation.places):,} places.")
        moves += [(simulation, goal) for goal in sets]
    columns = {"from": "s", "to": "s", "vocabulary": "s", "R@1": ".3f", "AP": ".3f", "regained": "s", "words": "d"}
    for scoring in Scoring:
        rows = [row for origin, goal in moves for row in _move(origin, goal, scoring)]
        report.table(f"Scoring by {scoring}", columns, rows)
    report.write()


def _gallery(described: DescribedSet) -> School:
    return School(described.place_set.name, [place.descriptors for place in described.gallery])


def _simulation(folder: Path, features: FeatureChoice) -> School:
    fleets = sorted(path.parent for path in folder.glob(f"*/{FLEET}"))
    images = [(image, fleet) for fleet in fleets for image in read_fleet_views(fleet).images]
    return School("simulation", [features.of(image, fleet).descriptors for image, fleet in images])


def _move(origin: School, goal: DescribedSet, scoring: Scoring) -> Iterator[tuple[object, ...]]:
    methods = {
        "static, trained there": (_gallery(goal), FIXED),
        "static, moved": (origin, FIXED),
        "incremental, moved": (origin, VocabularyConfig()),
    }
    truth = next(iter(goal.place_set.questions.values()))
    at_home: FloatArray | None = None
    for name, (school, config) in methods.items():
        index = PlaceIndex[int](config.model_copy(update={"scoring": scoring}), np.random.default_rng(SEED))
        index.train(school.places)
        scores = index_scores(index, goal)
        found = recall_at(scores, truth, 1)
        at_home = found if at_home is None else at_home
        gain = mean_interval(found - at_home, np.random.default_rng(SEED))
        average_precision = single_best(scores, truth).curve().average_precision
        regained = f"{gain.mean:+.3f} [{gain.low:+.3f}, {gain.high:+.3f}]"
        names = origin.name, goal.place_set.name
        yield *names, name, float(found.mean()), average_precision, regained, index.word_count


if __name__ == "__main__":
    main()
