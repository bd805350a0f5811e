"""The paper's figure 4: what words tell while places arrive, every strategy of the vocabulary beside brute force.

    FCSLAM_DATA=/path/to/data python benchmarks/figure4.py [--features vgg.onnx onnx orb]

The paper's 2,680 scenes of TUM sequences are not at hand. In their place arrive, one environment after another and 40
at a time: street scenes, rendered and real rooms, the floors of a tower but 11 to 15, a corridor, a desk; 500 features
on grey images of 400 pixels. The paper has one group of a target, another view and eight wrong places; here there are
120 groups from tower, corridor and desk, whose targets never arrive. Similarity is eq. (4) on the scale of [0, 1]; the
last table asks the index itself, with its default scoring, after the last place. Bands: 95 % by bootstrap over groups.
rebuild trains at every place, as Algorithm 1 does. The fixed tree is trained on photographs. The picture is that of the
first features.
"""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import common
import numpy as np
from evaluation.place_features import FeatureChoice, choose_features, describe_sets, describe_training
from evaluation.places import COLOURS, panel_figure, save
from evaluation.vocabulary_growth import (
    BATCH,
    MEASURES,
    Arrival,
    Growth,
    ahead_of,
    draw_groups,
    fixed_growths,
    group_measures,
    grow_vocabulary,
)

from fcslam.metrics.bootstrap import Interval, mean_interval
from fcslam.places.vocabulary import Strategy, VocabularyConfig
from fcslam.records import FloatArray

FIRST = (
    "camvid", "icl_nuim_snippet", "tum_rgbd/freiburg3_cabinet_58/rgb", "tum_rgbd/freiburg2_desk_snippet",
    "tum_rgbd/freiburg3_long_office_household_snippet",
)  # fmt: skip
SETS = ("ie_tower", "rtabmap_corridor", "tum_rgbd/freiburg1_rpy")
TRAINING = ("bsds500", "coco_subset", "urban100", "sun_hays80", "kodak24")
UNSEEN_FLOORS = {f"floor{number}" for number in range(11, 16)}
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
    images = common.recordings(*SETS, *FIRST, *TRAINING, kind="vision")
    for number, features in enumerate(map(choose_features, chosen.features)):
        growths, places, groups = grow(images, features)
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
        columns = {"": "s", **dict.fromkeys(MEASURES, "s")}
        report.table(f"{features.name}: as the index answers in the end", columns, _asked(growths))
        if number == 0:
            draw(report, growths, places, groups, PICTURE if chosen.results == common.RESULTS else None)
        report.write()  # after each detector, because all of them take an hour


def grow(images: Path, features: FeatureChoice) -> tuple[dict[str, Growth], int, int]:
    """Every strategy with these features; the number of places that arrive, and of groups."""
    floors = {path.name for path in (images / SETS[0]).iterdir() if path.is_dir()} - UNSEEN_FLOORS
    described = [
        each for name in SETS for each in describe_sets([images / name], floors if name == SETS[0] else (), features)
    ]
    groups, arrivals = draw_groups(described, GROUPS, np.random.default_rng(SEED))
    before = describe_training([images / name for name in FIRST], features)
    arrivals = [Arrival(f"first {k}", codes) for k, codes in enumerate(before)] + arrivals
    growths = fixed_growths(arrivals, groups, describe_training([images / name for name in TRAINING], features), SEED)
    for strategy in Strategy:
        growths[strategy] = grow_vocabulary(strategy, arrivals, groups, VocabularyConfig(), SEED)
    return growths, len(arrivals), len(groups)


def draw(report: common.Report, growths: dict[str, Growth], places: int, groups: int, picture: Path | None) -> None:
    caption = (
        f"{places} places, 40 at a time: CamVid, ICL-NUIM and TUM snippets, IE Tower without floors 11 to 15, "
        f"RTAB-Map corridor, freiburg1_rpy (in place of the paper's TUM scenes);\n"
        f"{groups} groups of the last three; bands: 95 %"
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


def _asked(growths: dict[str, Growth]) -> Iterator[tuple[object, ...]]:
    for name, growth in growths.items():
        if len(growth.asked):
            rng = np.random.default_rng(SEED)
            yield name, *(_shown(mean_interval(values, rng)) for values in group_measures(growth.asked).values())


def _shown(value: Interval) -> str:
    return f"{value.mean:.4g} [{value.low:.3g}, {value.high:.3g}]"


if __name__ == "__main__":
    main()
