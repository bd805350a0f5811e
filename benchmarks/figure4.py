"""The paper's figure 4: what words tell while places arrive, every strategy of the vocabulary beside brute force.

    FCSLAM_DATA=/path/to/data python benchmarks/figure4.py [--features vgg.onnx onnx orb]

The paper's 2,680 scenes of TUM sequences are not at hand. In their place arrive, one environment after another and 40
at a time: rendered and real rooms, a desk, floors 11 to 15 of a tower, a corridor; 500 features on grey images of 400
pixels. The paper has one group of a target, another view and eight wrong places; here there are 120 groups from the
floors and the corridor, which trained no network, and whose targets never arrive. Similarity is eq. (4) on the scale of
[0, 1]. Bands: 95 % by bootstrap over groups. windowed trains once for each 40 places, as the paper's experiment does.
rebuild, Algorithm 1 to the letter, trains at every place; after each 40 it has the same window of places, so it is only
timed, over the last 40 places. The picture is that of the first features. Times are CPU times of one core.
"""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import common
import numpy as np
from evaluation.place_features import FeatureChoice, choose_features, describe_images, describe_training
from evaluation.place_sets import read_place_set
from evaluation.places import COLOURS, panel_figure, save
from evaluation.vocabulary_growth import (
    BATCH,
    MEASURES,
    Arrival,
    Growth,
    ahead_of,
    draw_groups,
    fixed_growths,
    grow_vocabulary,
    last_seconds,
)

from fcslam.metrics.bootstrap import Interval
from fcslam.places.vocabulary import Strategy, VocabularyConfig
from fcslam.records import FloatArray

FIRST = (
    "icl_nuim_snippet", "tum_rgbd/freiburg3_cabinet_58/rgb", "tum_rgbd/freiburg2_desk_snippet",
    "tum_rgbd/freiburg3_long_office_household_snippet", "tum_rgbd/freiburg1_rpy/rgb",
)  # fmt: skip
TOWER, CORRIDOR = "ie_tower", "rtabmap_corridor"
UNSEEN_FLOORS = [f"floor{number}" for number in range(11, 16)]
GROUPS, SEED = 120, 1
PICTURE = common.REPOSITORY / "docs" / "images" / "figure4.png"
TITLES = {
    "significance": "(a) significance of the true match",
    "mismatch rate": "(b) mismatch rate",
    "wrong places, mean": "(c) similarity of wrong places, mean",
    "wrong places, variance": "(c) similarity of wrong places, variance",
    "words": "(d) words",
    "relative significance": "relative significance",
    "seconds": f"seconds to take in {BATCH} places",
}
LOGARITHMIC = ("words", "seconds")


def main() -> None:
    parser = common.options(__doc__ or "")
    parser.add_argument(
        "--features", nargs="+", default=["orb", "onnx"], help="detectors: orb, onnx (that of fcslam) or an .onnx file"
    )
    chosen = parser.parse_args()
    report = common.Report(__file__, __doc__ or "", chosen)
    images = common.recordings(TOWER, CORRIDOR, *FIRST, kind="vision")
    for number, features in enumerate(map(choose_features, chosen.features)):
        arrivals, growths, groups = grow(images, features)
        places = len(arrivals)
        of = f"{features.name}: eq. (4) after {places} places, {groups} groups"
        columns = {
            "": "s",
            **dict.fromkeys(MEASURES, "s"),
            "words": ".0f",
            "s for 40 places": ".2f",
            "the longest": ".2f",
        }
        report.table(of, columns, _ends(growths))
        columns = {"": "s", **dict.fromkeys(MEASURES[:3], "s")}
        report.table(f"{features.name}: incremental less the others, group by group", columns, _differences(growths))
        every_place = VocabularyConfig(strategy=Strategy.REBUILD, train_batch=places - BATCH - 1)
        seconds = last_seconds(every_place, arrivals, SEED)
        report.table(f"{features.name}: the last {BATCH} places", {"": "s", "s": ".2f"}, [("rebuild", seconds)])
        if number == 0:
            draw(report, growths, places, groups, PICTURE if chosen.results == common.RESULTS else None)
        report.write()  # after each detector, because all of them take an hour


def grow(images: Path, features: FeatureChoice) -> tuple[list[Arrival], dict[str, Growth], int]:
    """The places that arrive, every strategy with these features, and the number of groups."""
    unseen = read_place_set(images / TOWER, UNSEEN_FLOORS, every_image=True), read_place_set(images / CORRIDOR)
    described = [
        describe_images(each, images / name, features) for each, name in zip(unseen, (TOWER, CORRIDOR), strict=True)
    ]
    groups, arrivals = draw_groups(described, GROUPS, np.random.default_rng(SEED))
    before = describe_training([images / name for name in FIRST], features)
    arrivals = [Arrival(f"first {k}", codes) for k, codes in enumerate(before)] + arrivals
    growths = fixed_growths(arrivals, groups)
    for strategy in (Strategy.WINDOWED, Strategy.INCREMENTAL):
        growths[strategy] = grow_vocabulary(strategy, arrivals, groups, VocabularyConfig(), SEED)
    return arrivals, growths, len(groups)


def draw(report: common.Report, growths: dict[str, Growth], places: int, groups: int, picture: Path | None) -> None:
    caption = (
        f"{places} places, 40 at a time: ICL-NUIM and TUM snippets, freiburg1_rpy, IE Tower, RTAB-Map corridor "
        f"(in place of the paper's TUM scenes);\n{groups} groups of floors 11 to 15 and the corridor; bands: 95 %"
    )
    figure = draw_growth(growths, caption, SEED)
    report.picture(caption.replace("\n", " "), figure)
    if picture is not None:
        save(figure, picture)


def draw_growth(growths: Mapping[str, Growth], caption: str, seed: int) -> Any:
    figure, axes = panel_figure(len(TITLES), 4, (4.4, 3.6))
    for axis, (measure, title) in zip(axes, TITLES.items(), strict=True):
        for colour, (name, growth) in zip(COLOURS, growths.items(), strict=False):
            values = _series(growth, measure, seed)
            if np.isfinite(values[:, 0]).any():
                axis.plot(growth.places, values[:, 0], color=colour, linewidth=1.2, label=name)
                axis.fill_between(growth.places, values[:, 1], values[:, 2], color=colour, alpha=0.15, linewidth=0)
        axis.set(xlabel="places", title=title, yscale="log" if measure in LOGARITHMIC else "linear")
        axis.grid(alpha=0.3)
    figure.legend(*axes[0].get_legend_handles_labels(), loc="lower right", bbox_to_anchor=(0.94, 0.2))
    figure.supxlabel(caption, fontsize=9)
    return figure


def _series(growth: Growth, measure: str, seed: int) -> FloatArray:
    """Mean, lower and upper bound after every batch, shape (U, 3)."""
    if measure in MEASURES:
        return np.array([growth.intervals(update, seed)[measure] for update in range(len(growth.places))])
    values = growth.words if measure == "words" else growth.seconds
    return np.repeat(values[:, None], 3, axis=1)


def _ends(growths: dict[str, Growth]) -> Iterator[tuple[object, ...]]:
    for name, growth in growths.items():
        cells = [_shown(value) for value in growth.intervals(-1, SEED).values()]
        yield name, *cells, growth.words[-1], float(np.median(growth.seconds)), float(growth.seconds.max())


def _differences(growths: dict[str, Growth]) -> Iterator[tuple[object, ...]]:
    ours = growths[Strategy.INCREMENTAL]
    for name, growth in growths.items():
        if growth is not ours:
            yield name, *(_shown(ahead_of(ours, growth, measure, SEED)) for measure in MEASURES[:3])


def _shown(value: Interval) -> str:
    return f"{value.mean:.4g} [{value.low:.3g}, {value.high:.3g}]"


if __name__ == "__main__":
    main()
